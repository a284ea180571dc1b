"""``python -m dynslam_bench.cli``."""

from . import main

main()
