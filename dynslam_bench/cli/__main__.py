"""``python -m dynslam_bench.cli``."""

from dynslam_bench.cli import main

main()
