"""Studies that start from deliberately bad settings: how much of the planted loss they recover on held-out scenes.

    python tests/benchmarks/planted_gains.py [motion features threshold dilation] [--jobs 2] [--frames 60]
                                             [--scenes 8] [--trials 20] [--results FOLDER]

Each case is a tracker of which one default was made bad; the study does not know which. At the end the tracker as it is
published runs on the held-out scenes too: the loss is the log ATE ratio of the bad default to it, the recovered share
what the study's choice takes back of that. Scenes are rendered; results are kept, so that a second call goes on.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import create_model

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.trackers import TRACKERS

TUNED = ("features.n_features", "motion.enabled", "motion.threshold_px", "motion.min_share", "epipolar.threshold_px",
         "backend.keyframes.max_gap")  # fmt: skip
MASKED = ("segmentation.dilation_px", "segmentation.confidence", "segmentation.mask_threshold")
LEAST_LOSS = 0.05
"""Below this log ratio there is nothing to recover."""


def planted(name: str, tracker: str, bad: dict[str, Any]) -> TrackerSpec:
    """A tracker with bad default settings, under another id."""
    spec = TRACKERS.get(tracker)
    defaults = apply_overrides(spec.settings(), bad)
    fields = {
        group: (type(getattr(defaults, group)), getattr(defaults, group)) for group in type(defaults).model_fields
    }
    worse: Any = create_model(f"Planted{name.title()}", __base__=spec.settings, **fields)
    return replace(spec, id=f"planted-{name}", settings=worse, presets={})


MOTION = planted("motion", "emfoa-oft-no-masks", {"motion.enabled": False})
FEATURES = planted("features", "emfoa-oft-no-masks", {"features.n_features": 500})
THRESHOLD = planted("threshold", "emfoa-oft-no-masks", {"motion.threshold_px": 10.0})
DILATION = planted("dilation", "emfoa-oft", {"segmentation.dilation_px": 0, "segmentation.source": "embedded"})


def study(case: str, options: argparse.Namespace) -> str:
    """Run one study and say what it recovered."""
    from dynslam_bench.tuning import StudySpec, finish, run_study
    from dynslam_bench.tuning.evaluate import evaluate
    from dynslam_bench.tuning.objectives import ACCURACY

    masked = case == "dilation"
    fixed = {"segmentation.source": "embedded"} if masked else {}
    frames, last = options.frames, options.scenes - 1
    spec = StudySpec(
        name=f"planted-{case}", tracker=f"{Path(__file__).resolve()}:{case.upper()}",
        tune=(f"synthetic/walking_xyz@0-{last}?frames={frames}",), offsets=(0,), recorded=(),
        confirm=(f"synthetic/walking_xyz@{last + 1}-{2 * last + 1}?frames={frames}",),
        held_out=(f"synthetic/walking_xyz@100-{100 + last}?frames={frames}",), trials=options.trials, top=2,
        space={"include": (*TUNED, *(MASKED if masked else ())), "fixed": fixed}, min_coverage=0.9, pilot=False,
    )  # fmt: skip
    began = time.perf_counter()
    tuner = run_study(
        spec, results=options.results, jobs=options.jobs, on_event=lambda event: print(event.text, flush=True)
    )
    summary = finish(tuner, lambda text: print(text, flush=True), jobs=options.jobs)
    minutes = (time.perf_counter() - began) / 60
    chosen = {} if summary.chosen is None else summary.candidates[0].params
    held = tuner.design.held_out

    good = "emfoa-oft" if masked else "emfoa-oft-no-masks"
    published = evaluate(good, fixed, held, results=tuner.store, jobs=options.jobs)
    loss, left = (
        ACCURACY.value(tuner.evaluate({**fixed, **own}, held, jobs=options.jobs, cache=False), published)
        for own in ({}, chosen)
    )
    share = f"{100 * (1 - left / loss):.0f} %" if loss > LEAST_LOSS else "nothing to recover"
    return (
        f"{case}: planted loss {loss:+.3f} in log ATE, after the study {left:+.3f}: recovered {share} in "
        f"{minutes:.1f} min, {summary.trials}\n  {summary.conclusion}\n  {chosen}"
    )


def say(text: str) -> None:
    """Print what goes on."""
    print(text, flush=True)


def main() -> None:
    """Run the cases that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cases = ("motion", "features", "threshold", "dilation")
    parser.add_argument("cases", nargs="*", default=cases, metavar="CASE", help=", ".join(cases))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--results", type=Path, default=Path("results/planted"))
    options = parser.parse_args()
    for case in options.cases:
        print(study(case, options), flush=True)


if __name__ == "__main__":
    main()
