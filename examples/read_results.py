"""Stored runs as pandas frames, and two figures of them.

dynslam-bench run orb-slam2 'synthetic/walking_xyz?scene=100' --frames 0:60        # or any other
runs python examples/read_results.py [RESULTS] [FOLDER FOR THE FIGURES]
"""

import sys
from pathlib import Path

import plotly.express as px

from dynslam_bench.runs import RunStore, load_frames


def main(results: str = "results", figures: str = "figures") -> None:
    # one row a run; another protocol runs nothing again
    runs = RunStore(results).frame("tum-rgbd/v1")
    done = runs[runs["status"] == "ok"]
    print(done.groupby(["sequence", "label"])["ate_rmse_m"].agg(["count", "median", "max"]))

    latest = done.iloc[-1]
    # one row a frame: state, errors, seconds by stage, diagnostics
    frames = load_frames(latest["run_id"], results)
    slow = frames.nlargest(3, "total_s")[["index", "total_s", "pose_error_trans_m"]]
    print(f"\nslowest frames of {latest['label']} on {latest['sequence']}:\n{slow}")

    Path(figures).mkdir(parents=True, exist_ok=True)
    px.strip(done, x="label", y="ate_rmse_m", color="sequence").write_html(
        Path(figures, "ate.html")
    )
    error = frames[["index", "pose_error_trans_m", "frame_error_trans_m"]].astype(float)
    px.line(error, x="index", y=["pose_error_trans_m", "frame_error_trans_m"]).write_html(
        Path(figures, "frames.html")
    )


if __name__ == "__main__":
    main(*sys.argv[1:3])
