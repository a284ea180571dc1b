"""Print how well the surrogates predict configurations that they were not fitted to, by five-fold cross-validation.

python surrogate_error.py
"""

import sys

import numpy as np
from scipy.stats import spearmanr
from slam_hpo import FRAMES, SEQUENCES, SPACES, SPLITS, load
from slam_hpo.table import Surrogate, transformed

lines = [
    "| system | configurations | split | rank correlation, mean of the split | of two starts | one instance | "
    "residual, log ATE | expected | noise of a run |",
    "| --- | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
]
for system in SPACES:
    bench = load(system)
    units = np.stack([bench.units(bench.configuration(i)) for i in range(len(bench.values))])
    truth = transformed(bench.values)[..., FRAMES.index(60), 0]

    # mean and standard deviation of log ATE [configurations, sequences, starts] from the other folds
    fold = np.random.default_rng(0).permutation(len(units)) % 5
    mean = np.empty_like(truth)
    std = np.empty_like(truth)
    for k in range(5):
        predicted = Surrogate(units[fold != k], bench.values[fold != k]).predict(units[fold == k])
        mean[fold == k], std[fold == k] = (part[..., FRAMES.index(60), 0] for part in predicted)

    # rank correlations over configurations, and residuals
    for split, names in SPLITS.items():
        at = [SEQUENCES.index(name) for name in names]
        predictions = mean[:, at]
        errors = truth[:, at]
        whole = spearmanr(predictions.mean(axis=(1, 2)), errors.mean(axis=(1, 2)))[0]
        starts = spearmanr(errors[:, :, 0].mean(axis=1), errors[:, :, 1].mean(axis=1))[0]
        correlations = [
            spearmanr(predictions[:, s, k], errors[:, s, k])[0]
            for s in range(errors.shape[1])
            for k in range(errors.shape[2])
        ]
        single = np.median(correlations)
        residual = np.sqrt(np.mean((predictions - errors) ** 2))
        expected = np.sqrt(np.mean(std[:, at] ** 2))
        lines.append(
            f"| `{system}` | {len(units)} | {split} | {whole:.2f} | {starts:.2f} | {single:.2f} | {residual:.3f} | "
            f"{expected:.3f} | {bench.noise():.3f} |"
        )
sys.stdout.write("\n".join(lines) + "\n")
