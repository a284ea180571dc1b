"""The renderer of dynamic RGB-D sequences with exact poses, depth, masks and flow."""
