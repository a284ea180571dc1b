"""The measured runs of a system, and the surrogate between them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import cached_property, lru_cache
from importlib.resources import files
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from slam_hpo.spaces import FRAMES, SEQUENCES, SPACES, STARTS, SlamHpoError, Value, defaults, known

METRICS = ("ate_m", "coverage", "processor_s")
"""What is measured of a run: the last axis of `Benchmark.values`."""
LOST_COVERAGE = 0.5
"""A run that tracks less than this share of its frames is lost."""
# What an instance consists of, and the choices of each: the middle axes of `Benchmark.values`.
INSTANCE = (("sequence", SEQUENCES), ("start", STARTS), ("frames", FRAMES))


class Evaluation(NamedTuple):
    """What a configuration has on an instance.

    Attributes:
        ate_m: Online ATE RMSE in metres after rigid alignment; lost frames are held at the last
            pose.
        coverage: Share of the frames that were tracked.
        processor_s: Mean processor seconds a frame; varies with the machine's load by a quarter.
        status: How the run ended: ``ok``, ``lost``, ``crashed``, ``timeout``, ``out-of-memory``.
        log_ate_std: Standard deviation of log ATE as the surrogate knows it; 0 where it was
            measured.
    """

    ate_m: float
    coverage: float
    processor_s: float
    status: str = "ok"
    log_ate_std: float = 0.0


class Benchmark:
    """A system's table: every configuration on all sequences, starts and numbers of frames.

    Attributes:
        system: Tracker of dynslam-bench.
        space: Its settings.
        configurations: One row a configuration, the default first.
        values: float64 ``[configurations, sequences, starts, fidelities, 3]``, see `METRICS`.
        status: object ``[configurations, sequences, starts, fidelities]``, how the runs ended.
    """

    def __init__(self, system: str, rows: pd.DataFrame) -> None:
        self.system = system
        self.space = SPACES[system]

        # the configurations, the default first
        names = [*self.space]
        keys = rows[names].round(6)
        unique = keys.drop_duplicates()
        first = (unique == pd.Series(defaults(system))).all(axis=1)
        self.configurations = pd.concat([unique[first], unique[~first]], ignore_index=True)
        self._index = {
            row: index
            for index, row in enumerate(self.configurations.itertuples(index=False, name=None))
        }

        # each run into its cell of the table
        at = [np.array([self._index[row] for row in keys.itertuples(index=False, name=None)])]
        at += [
            pd.Categorical(rows[column], categories=choices).codes for column, choices in INSTANCE
        ]
        shape = (len(unique), len(SEQUENCES), len(STARTS), len(FRAMES))
        self.values = np.full((*shape, len(METRICS)), np.nan)
        self.values[tuple(at)] = rows[[*METRICS]]
        self.status = np.full(shape, "", dtype=object)
        self.status[tuple(at)] = rows["status"]

    def configuration(self, index: int) -> dict[str, Value]:
        """A measured configuration.

        Raises:
            SlamHpoError: There is none of this number.
        """
        number = known("configuration", index, range(len(self.configurations)))
        row = self.configurations.iloc[number]
        return {
            name: int(row[name]) if setting.whole else float(row[name])
            for name, setting in self.space.items()
        }

    def units(self, settings: Mapping[str, Any]) -> NDArray[np.float64]:
        """A configuration as a point of the unit cube, settings in the order of `space`.

        Raises:
            SlamHpoError: A setting is missing, unknown or out of its range.
        """
        if not isinstance(settings, Mapping):
            raise SlamHpoError(
                f"the settings are {settings!r}: give a value for each of {', '.join(self.space)}"
            )
        if settings.keys() != self.space.keys():
            wrong = ", ".join(sorted(map(str, settings.keys() ^ self.space.keys())))
            raise SlamHpoError(
                f"{self.system} has the settings {', '.join(self.space)}; missing or unknown: {wrong}"
            )
        for name, value in settings.items():
            setting = self.space[name]
            if not isinstance(value, Real) or (setting.whole and value % 1):
                kind = "whole number" if setting.whole else "number"
                raise SlamHpoError(f"{name} = {value!r} is no {kind}")
            if not setting.low <= value <= setting.high:
                raise SlamHpoError(f"{name} = {value} is outside {setting.low} to {setting.high}")
        return np.array([setting.unit(settings[name]) for name, setting in self.space.items()])

    def measured(
        self, settings: Mapping[str, Any], sequence: str, *, start: int = 0, frames: int = 60
    ) -> Evaluation:
        """What a run of the table has.

        Args:
            settings: Every setting, by dotted name.
            sequence: One of `SEQUENCES`.
            start: One of `STARTS`.
            frames: One of `FRAMES`.

        Raises:
            SlamHpoError: It is not in the table; the message names the nearest configuration.
        """
        where = _place(sequence, start, frames)
        unit = self.units(settings)
        index = self._index.get(tuple(round(float(settings[name]), 6) for name in self.space))
        if index is None:
            nearest = int(np.abs(self._units - unit).sum(axis=1).argmin())
            raise SlamHpoError(
                f"no run has these settings; the nearest is configuration({nearest}), or use `predicted`"
            )
        ate, coverage, processor = self.values[(index, *where)].tolist()
        return Evaluation(ate, coverage, processor, self.status[(index, *where)])

    def predicted(
        self, settings: Mapping[str, Any], sequence: str, *, start: int = 0, frames: int = 60
    ) -> Evaluation:
        """What the surrogate expects of any configuration; arguments as for `measured`.

        Raises:
            SlamHpoError: A setting, sequence, start or number of frames is not of the benchmark.
        """
        where = _place(sequence, start, frames)
        means, stds = self.surrogate.predict(self.units(settings)[None])
        mean = means[(0, *where)]
        std = stds[(0, *where)]
        ate, coverage, processor = natural(mean).tolist()
        status = "ok" if coverage >= LOST_COVERAGE else "lost"
        return Evaluation(ate, coverage, processor, status, log_ate_std=float(std[0]))

    def noise(self, frames: int = 60, metric: str = "ate_m") -> float:
        """Standard deviation of a metric's logarithm between starts, on the same sequence with the same settings.

        Raises:
            SlamHpoError: No such number of frames or metric.
        """
        fidelity = known("frames", frames, FRAMES)
        column = known("metric", metric, METRICS)
        logarithm = np.log(self.values[:, :, :, FRAMES.index(fidelity), METRICS.index(column)])
        # a difference of two starts has twice the variance of one; what all configurations have in
        # common between the starts is no noise
        between = logarithm[:, :, 0] - logarithm[:, :, 1]
        return float(np.sqrt(np.mean((between - between.mean(axis=0)) ** 2) / 2))

    @cached_property
    def _units(self) -> NDArray[np.float64]:
        """The configurations in the unit cube, ``[configurations, settings]``."""
        return np.stack(
            [self.space[name].unit(self.configurations[name]) for name in self.space], axis=1
        )

    @cached_property
    def surrogate(self) -> Surrogate:
        """Fitted on first use, in some seconds."""
        return Surrogate(self._units, self.values)

    def hpob(self) -> dict[str, Any]:
        """The table in HPO-B's form: ``{system: {instance: {"X": [[...]], "y": [[...]]}}}``.

        y is the negative ATE in metres, as HPO-B maximises.
        """
        points = self._units.tolist()
        return {
            self.system: {
                f"{sequence}, start {start}": {
                    "X": points,
                    "y": (-self.values[:, s, k, -1, :1]).tolist(),
                }
                for s, sequence in enumerate(SEQUENCES)
                for k, start in enumerate(STARTS)
            }
        }


class Surrogate:
    """A Gaussian process for every instance: Matern-5/2 kernel, one length a setting, shared by all instances.

    Standard deviations are scaled per instance and metric so that they fit the leave-one-out
    residuals.

    Args:
        units: float64 ``[N, D]``, configurations in the unit cube.
        values: See `Benchmark.values`.
    """

    def __init__(self, units: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

        self._shape = values.shape[1:]
        targets = transformed(values).reshape(len(values), -1)
        lengths = [1.0] * units.shape[1]
        kernel = ConstantKernel() * Matern(lengths, (0.05, 50.0), nu=2.5) + WhiteKernel(
            0.2, (1e-3, 2.0)
        )
        self.process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0)
        with warnings.catch_warnings():  # a setting without effect has the longest length
            warnings.simplefilter("ignore", ConvergenceWarning)
            self.process.fit(units, targets)

        # leave-one-out residual alpha_i / K^-1_ii, its variance 1 / K^-1_ii, and their ratio
        precision = np.diag(np.linalg.inv(self.process.L_ @ self.process.L_.T))
        self._calibration = np.sqrt(np.mean(self.process.alpha_**2 / precision[:, None], axis=0))

    def predict(
        self, units: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Means and standard deviations ``[N, sequences, starts, fidelities, 3]``, see `transformed`."""
        mean, std = self.process.predict(units, return_std=True)
        shape = (len(units), *self._shape)
        return mean.reshape(shape), (std * self._calibration).reshape(shape)


def transformed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metrics as the surrogate has them: logarithms of error and time."""
    metrics = values.copy()
    metrics[..., [0, 2]] = np.log(metrics[..., [0, 2]])
    return metrics


def natural(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of `transformed`; coverage is clipped to its range."""
    ate, coverage, processor = np.moveaxis(values, -1, 0)
    return np.stack([np.exp(ate), np.clip(coverage, 0, 1), np.exp(processor)], axis=-1)


def _place(sequence: str, start: int, frames: int) -> tuple[int, int, int]:
    """The place of an instance in the middle axes of `Benchmark.values`."""
    return (
        SEQUENCES.index(known("sequence", sequence, SEQUENCES)),
        STARTS.index(known("start", start, STARTS)),
        FRAMES.index(known("frames", frames, FRAMES)),
    )


def load(system: str) -> Benchmark:
    """The benchmark of a system.

    Raises:
        SlamHpoError: There is none.
    """
    return _load(known("system", system, SPACES))


@lru_cache
def _load(system: str) -> Benchmark:
    name = system.partition("?")[0]
    with files("slam_hpo").joinpath("data", f"{name}.parquet").open("rb") as file:
        return Benchmark(system, pd.read_parquet(file))
