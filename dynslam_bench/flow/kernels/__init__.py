"""How the flow's kernels are compiled, and the values they compute with."""
