"""The families of rendered sequences: one file a family, each a description on shared machinery."""
