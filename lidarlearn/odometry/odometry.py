"""The odometry: one pose per scan, from an initialization and a registration backend."""

import math
from collections import deque
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.ranges import in_range
from lidarlearn.odometry.attempt import Attempt, Guess
from lidarlearn.odometry.backend import Backend
from lidarlearn.odometry.health import Health, Status
from lidarlearn.odometry.hypotheses import start_motions, surprise_motions
from lidarlearn.odometry.initialization.base import Initialization
from lidarlearn.odometry.judgement import Judgement, motion_difference
from lidarlearn.odometry.sampling import SampledScan
from lidarlearn.odometry.scan_by_scan import Frame, Points, ScanByScan, Times, are_shares_of_a_period, as_scan

_CLOSE_GUESS_ERROR_M = 0.1  # `Guess.error_m` of a motion that was found among several, or of the last one


class Odometry(ScanByScan):
    """Registers each scan, from an initial guess of its motion, against a local map of the scans before it.

    Args:
        initialization: guesses the motion.
        backend: samples, registers and keeps the map; what it holds of another drive is forgotten.
        judgement: when a registration is doubted.
        min_range_m: closer returns are dropped: the vehicle itself [m].
        max_range_m: farther returns are dropped [m].
        recovery: whether a doubtful registration is tried again from other motions, and the start from several.
        device: where everything runs.

    Source: Dellenbach et al. 2021, III-A.
    """

    def __init__(
        self,
        initialization: Initialization,
        backend: Backend,
        judgement: Judgement | None = None,
        min_range_m: float = 2.5,
        max_range_m: float = 100.0,
        recovery: bool = True,
        device: torch.device | str = "cpu",
    ) -> None:
        self._initialization = initialization
        self._backend = backend
        backend.local_map.restart()
        self._judgement = judgement or Judgement()
        self._min_range_m = min_range_m
        self._max_range_m = max_range_m
        self._recovery = recovery
        self._device = torch.device(device)
        self._T_world_lidar = se3.identity()
        self._motion = se3.identity()  # last one that was trusted
        self._doubted_motion: Tensor | None = None
        self._first: _Beginning | None = None  # the map's only scan, as long as no other was registered to it
        self._surprises_m: deque[float] = deque(maxlen=5)
        self._fits: deque[float] = deque(maxlen=5)
        self._frames = 0
        self._coasting = 0

    @torch.no_grad()
    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """Guess the motion, register, judge, try again if in doubt, add the scan to the map."""
        points, times = self._in_range(*as_scan(points, times, self._device))
        initial = self._initialization.predict(points, self._motion.clone())
        guess = Guess(initial.T_previous_new, initial.source, max(self._surprises_m, default=math.inf))
        scan = self._backend.sampling.sample(points, times)
        if self._backend.local_map.association.is_empty:
            health = self._begin(scan)
        elif not self._has_enough_points(scan):
            self._coast()
            health = self._unregistered(scan, guess.source, "coasted")
        elif self._first is not None:
            health = self._set_off(scan, self._first, guess)
        else:
            health = self._advance(scan, guess)
        self._frames += 1
        return Frame(self._T_world_lidar.clone(), health)

    def _in_range(self, points: Tensor, times: Tensor | None) -> tuple[Tensor, Tensor | None]:
        kept = in_range(points, self._min_range_m, self._max_range_m)
        if times is not None:
            kept = kept[are_shares_of_a_period(times.index_select(0, kept))]
        return points.index_select(0, kept), None if times is None else times.index_select(0, kept)

    def _begin(self, scan: SampledScan) -> Health:
        """Start a map with a scan, at the origin or, after a loss, where the motion model puts it."""
        if self._frames:
            self._move(self._motion)
        if not self._has_enough_points(scan):
            return self._unregistered(scan, "start", "coasted")
        self._backend.local_map.update(scan.deskewed(self._motion), self._T_world_lidar)
        self._first = _Beginning(scan, self._T_world_lidar)
        self._coasting = 0
        return self._unregistered(scan, "start", "restarted" if self._frames else "ok")

    def _set_off(self, scan: SampledScan, first: "_Beginning", guess: Guess) -> Health:
        """Register a scan to the only one there is, from motions of all kinds: none has been seen yet."""
        if self._recovery:
            motion = self._search(scan, start_motions(guess.T_previous_new))
            guess = Guess(motion, "start", _CLOSE_GUESS_ERROR_M)
        if first.scan.times is not None:
            self._deskew_first(first, scan, guess)
        return self._advance(scan, guess)

    def _deskew_first(self, first: "_Beginning", scan: SampledScan, guess: Guess) -> None:
        """Compensate the first scan, too, once the motion is known: what is skewed in the map stays in the poses."""
        attempt = self._register(scan, guess)
        if self._judgement.accepts(attempt.result):
            self._backend.local_map.restart()
            self._backend.local_map.update(
                first.scan.deskewed(self._per_scan(attempt.T_previous_new)), first.T_world_lidar
            )

    def _advance(self, scan: SampledScan, guess: Guess) -> Health:
        """Register a scan, from its guess and in doubt from others, or let the motion model carry on."""
        status: Status = "ok"
        attempt = self._register(scan, guess)
        if self._recovery and self._first is None and self._is_doubtful(attempt):
            attempt, status = self._try_others(scan, attempt), "recovered"
        if self._judgement.accepts(attempt.result):
            self._accept(scan, guess, attempt)
        else:
            status = "coasted"
            self._coast()
        return attempt.health(self._frames, len(scan.queries), status)

    def _accept(self, scan: SampledScan, guess: Guess, attempt: Attempt) -> None:
        """Take over the motion, and add the scan to the map."""
        self._fits.append(attempt.result.fit.item())
        self._surprises_m.append(_displacement_m(scan, guess.T_previous_new, attempt.T_previous_new))
        self._trust(attempt)
        self._backend.local_map.update(scan.deskewed(self._motion, attempt.result.skew), self._T_world_lidar)
        self._first = None
        self._coasting = 0

    def _try_others(self, scan: SampledScan, doubtful: Attempt) -> Attempt:
        """The most credible of a registration in doubt, one from the last motion and one from the best of many."""
        attempts, T_guess = [doubtful], doubtful.guess.T_previous_new
        if not torch.equal(T_guess, self._motion):
            attempts.append(self._register(scan, Guess(self._motion, "recovery", _CLOSE_GUESS_ERROR_M)))
        if self._is_doubtful(attempts[-1]):
            found = self._search(scan, surprise_motions(T_guess, self._motion))
            attempts.append(self._register(scan, Guess(found, "recovery", _CLOSE_GUESS_ERROR_M)))
        return max(attempts, key=lambda attempt: self._credibility(scan, attempt))

    def _is_doubtful(self, attempt: Attempt) -> bool:
        if attempt.is_implausible or not self._judgement.accepts(attempt.result):
            return True
        if attempt.result.fit.item() < self._judgement.min_fit_share * max(self._fits, default=0.0):
            return True
        # Where the map says too little, what was guessed remains.
        guessed = motion_difference(self._motion, attempt.guess.T_previous_new)
        return attempt.is_degenerate and not self._judgement.is_plausible(guessed)

    def _register(self, scan: SampledScan, guess: Guess) -> Attempt:
        result = self._backend.register(scan, guess.T_previous_new, self._T_world_lidar, guess.error_m, self._per_scan)
        motion = se3.orthonormalize(torch.linalg.solve(self._T_world_lidar, result.T_world_lidar))
        deviation = motion_difference(self._motion, motion)
        min_information = max(self._judgement.min_information, self._backend.registration.min_information)
        return Attempt(
            guess,
            result,
            motion,
            deviation,
            is_implausible=self._first is None and not self._judgement.is_plausible(deviation),
            is_degenerate=result.information[0].item() < min_information,
        )

    def _credibility(self, scan: SampledScan, attempt: Attempt) -> float:
        agreement = self._backend.agreement(scan, attempt.T_previous_new, self._T_world_lidar)
        return self._judgement.credibility(agreement, motion_difference(self._motion, attempt.T_previous_new))

    def _search(self, scan: SampledScan, guesses: Float[Tensor, "h 4 4"]) -> Tensor:
        """The most credible of the motions that several guesses lead to."""
        is_map_skewed = self._first is not None  # a compensated scan would not fit one that is not
        motions, agreements = self._backend.register_hypotheses(scan, guesses, self._T_world_lidar, not is_map_skewed)
        if self._first is not None:
            return motions[agreements.argmax()]
        deviations = [motion_difference(self._motion, motion) for motion in motions]
        credibilities = map(self._judgement.credibility, agreements.tolist(), deviations)
        return motions[torch.tensor(list(credibilities)).argmax()]

    def _coast(self) -> None:
        """Move as before; after too many scans without a registration, begin a new map."""
        self._move(self._motion)
        self._coasting += 1
        if self._coasting >= self._judgement.restart_after:
            self._backend.local_map.restart()

    def _trust(self, attempt: Attempt) -> None:
        """Move, and take over the motion as the model of the next one if it is plausible or seen twice."""
        motion = attempt.T_previous_new
        per_scan = self._per_scan(motion)
        self._move(motion)
        doubted, self._doubted_motion = self._doubted_motion, None
        confirmed = doubted is not None and self._judgement.is_plausible(motion_difference(doubted, motion))
        if not attempt.is_implausible or confirmed:
            self._motion = per_scan
        else:
            self._doubted_motion = motion

    def _per_scan(self, motion: Tensor) -> Tensor:
        """The motion over one scan period: where scans after a map's first were lost, a share of that since then."""
        if self._first is None or not self._coasting:
            return motion
        T_first_new = torch.linalg.solve(self._first.T_world_lidar, self._T_world_lidar @ motion)
        return se3.exp(se3.log(T_first_new) / (1 + self._coasting))

    def _move(self, motion: Tensor) -> None:
        self._T_world_lidar = se3.orthonormalize(self._T_world_lidar @ motion)

    def _unregistered(self, scan: SampledScan, source: str, status: Status) -> Health:
        return Health(self._frames, status, source, len(scan.queries))

    def _has_enough_points(self, scan: SampledScan) -> bool:
        return len(scan.queries) >= self._judgement.min_points


@dataclass(frozen=True)
class _Beginning:
    """The first scan of a map, and where it was begun."""

    scan: SampledScan
    T_world_lidar: Float[Tensor, "4 4"]


def _displacement_m(scan: SampledScan, T_guess: Tensor, T_previous_new: Tensor) -> float:
    """How far a point at the mean range was from where the guess had it."""
    surprise = motion_difference(T_guess, T_previous_new)
    return surprise.distance_m + math.radians(surprise.angle_deg) * scan.mean_range_m
