"""``python -m dynslam_bench``: the command line."""

from dynslam_bench.cli import main

main()
