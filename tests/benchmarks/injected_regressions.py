"""Studies that start from deliberately bad settings: how much of the injected loss they recover on held-out scenes.

    python tests/benchmarks/injected_regressions.py [motion features threshold dilation] [--jobs 2] [--frames 60]
                                             [--scenes 8] [--trials 20] [--results FOLDER]

Each case is a tracker of which one default was made bad; the study does not know which. At the end the tracker as it is
published runs on the held-out scenes too: the loss is the log ATE ratio of the bad default to it, the recovered share
what the study's best trial takes back of that. The loss is looked at first: where its interval does not lie above 1
there is nothing to recover, and no study is run. Scenes are rendered; results are kept, so that a second call goes on.
"""

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import create_model

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import SpaceSpec, Study, StudySpec, finish
from dynslam_bench.tuning.judgement import compared
from dynslam_bench.tuning.objectives import SPEED, evaluate

UNMASKED = ("features.n_features", "motion.enabled", "motion.threshold_px", "motion.threshold_sigma",
            "epipolar.threshold_px", "backend.keyframes.max_gap")  # fmt: skip
MASKED = ("features.n_features", "segmentation.dilation_px", "segmentation.confidence", "segmentation.mask_threshold",
          "backend.keyframes.max_gap")  # fmt: skip


def injected(name: str, tracker: str, bad: dict[str, Any]) -> TrackerSpec:
    """A tracker with bad default settings, under another id."""
    spec = TRACKERS.get(tracker)
    defaults = apply_overrides(spec.settings(), bad)
    fields = {
        group: (type(getattr(defaults, group)), getattr(defaults, group)) for group in type(defaults).model_fields
    }
    worse: Any = create_model(f"Injected{name.title()}", __base__=spec.settings, **fields)
    return replace(spec, id=f"injected-{name}", settings=worse, presets={})


MOTION = injected("motion", "emfoa-oft?masks=none", {"motion.enabled": False})
FEATURES = injected("features", "mask-rcnn", {"features.n_features": 500, "segmentation.source": "embedded"})
THRESHOLD = injected("threshold", "emfoa-oft?masks=none", {"motion.threshold_px": 10.0})
DILATION = injected("dilation", "mask-rcnn", {"segmentation.dilation_px": 0, "segmentation.source": "embedded"})
MASKED_CASES = ("features", "dilation")
SCENES = {
    "motion": ("objects_balloon",),
    "threshold": ("objects_balloon",),
    "features": ("walking_xyz", "walking_halfsphere"),
    "dilation": ("walking_xyz", "walking_halfsphere"),
}
"""Where the setting matters: a balloon has no mask, and free space sees what the motion test sees elsewhere."""


def study_of(case: str, options: argparse.Namespace) -> StudySpec:
    """The study of a case; choice and judgement on other instances than those of the trials."""
    masked = case in MASKED_CASES
    kinds = SCENES[case]
    share = max(1, options.scenes // len(kinds))

    def scenes(first: int) -> tuple[str, ...]:
        return tuple(f"synthetic/{kind}?scene={first}-{first + share - 1}&frames={options.frames}" for kind in kinds)

    return StudySpec(
        name=f"injected-{case}", tracker=f"{Path(__file__).resolve()}:{case.upper()}",
        tune=scenes(0), confirm=scenes(share), held_out=scenes(110), offsets=(0,), recorded=(),
        trials=options.trials, top=2, min_coverage=0.9,
        space=SpaceSpec(include=MASKED if masked else UNMASKED,
                        fixed={"segmentation.source": "embedded"} if masked else {}),
    )  # fmt: skip


def study(case: str, options: argparse.Namespace) -> str:
    """Look at a injection's loss; where there is one, run a study and say what it recovered."""
    tuner = Study(study_of(case, options), options.results)
    fixed, held = tuner.spec.space.fixed, tuner.design.held_out
    good = "mask-rcnn" if case in MASKED_CASES else "emfoa-oft?masks=none"
    published = evaluate(good, fixed, held, results=tuner.store, jobs=options.jobs)
    injected = tuner.outcomes(fixed, held, jobs=options.jobs, cache=False)
    loss = compared(injected, published)
    if not loss.shows_loss:
        time_taken = compared(injected, published, objective=SPEED)
        return (
            f"{case}: nothing to recover, no loss in {loss.n} held-out runs: {loss}, bound {loss.bound}; {time_taken}"
        )
    began = time.perf_counter()
    tuner.run(jobs=options.jobs, on_event=lambda event: print(event.text, flush=True))
    summary = finish(tuner, lambda text: print(text, flush=True), jobs=options.jobs)
    minutes = (time.perf_counter() - began) / 60
    best = {} if summary.best is None else summary.best.params
    left = compared(tuner.outcomes({**fixed, **best}, held, jobs=options.jobs, cache=False), published)
    share = 100 * (1 - math.log(left.ratio) / math.log(loss.ratio))
    return (
        f"{case}: injected {loss}, after the study {left}: recovered {share:.0f} % in {minutes:.1f} min, "
        f"{summary.trials}\n  {summary.conclusion}\n  {best}"
    )


def main() -> None:
    """Run the cases that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cases = ("motion", "features", "threshold", "dilation")
    parser.add_argument("cases", nargs="*", default=cases, metavar="CASE", help=", ".join(cases))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--results", type=Path, default=Path("results/injected"))
    options = parser.parse_args()
    for case in options.cases:
        print(study(case, options), flush=True)


if __name__ == "__main__":
    main()
