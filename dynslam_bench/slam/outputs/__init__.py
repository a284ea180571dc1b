"""What a map leaves behind: files and the sheet of five panels."""

from dynslam_bench.contracts.map_outputs import KeyframeRecord, MapOutputs

from .map_files import write_keyframes_csv, write_ply

__all__ = ["KeyframeRecord", "MapOutputs", "write_keyframes_csv", "write_ply"]
