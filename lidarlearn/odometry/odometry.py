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
from lidarlearn.odometry.base import BaseOdometry, Frame, Points, Times, are_shares_of_a_period, as_scan
from lidarlearn.odometry.health import Health, Status
from lidarlearn.odometry.hypotheses import start_motions, surprise_motions
from lidarlearn.odometry.initialization.base import Initialization
from lidarlearn.odometry.judgement import Judgement
from lidarlearn.odometry.sampling import SampledScan
from lidarlearn.registration.result import RegistrationResult

_CLOSE_GUESS_ERROR_M = 0.1  # `Guess.error_m` of a motion that was found among several, or of the last one


class Odometry(BaseOdometry):
    """Registers each scan, from an initial guess of its motion, against a local map of the scans before it.

    Args:
        initialization: guesses the motion.
        backend: samples, registers and keeps the map, which is cleared first.
        judgement: when a registration is accepted, and when it is doubted.
        min_range_m: closer points are dropped, as they lie on the vehicle [m].
        max_range_m: farther points are dropped [m].
        recovery: whether other motions are tried for a map's second scan, and after a doubtful registration.
        device: where points are processed.

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
        self._last_motion = se3.identity()  # over one scan period; the last one that was plausible or confirmed
        self._doubted_motion: Tensor | None = None
        self._first_scan: _FirstScan | None = None  # of the map, until another scan is registered to it
        self._guess_errors_m: deque[float] = deque(maxlen=5)
        self._accepted: deque[RegistrationResult] = deque(maxlen=5)
        self._frames = 0
        self._coasted = 0  # scans since the last one in the map

    @torch.no_grad()
    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """Guess the motion, register, judge, try again if in doubt, add the scan to the map."""
        points, times = self._in_range(*as_scan(points, times, self._device))
        initial = self._initialization.predict(points, self._last_motion.clone())
        guess = Guess(initial.T_previous_new, initial.source, max(self._guess_errors_m, default=math.inf))
        scan = self._backend.sampling.sample(points, times)
        if self._backend.local_map.association.is_empty:
            health = self._start_map(scan)
        elif not self._has_enough_points(scan):
            self._coast()
            health = self._unregistered(scan, guess.source, "coasted")
        elif self._first_scan is not None:
            health = self._register_second_scan(scan, self._first_scan, guess)
        else:
            health = self._register_and_update(scan, guess)
        self._frames += 1
        return Frame(self._T_world_lidar.clone(), health)

    @property
    def _is_starting(self) -> bool:
        """Whether the map holds its first scan only, not deskewed yet, so that no motion is known."""
        return self._first_scan is not None

    def _in_range(self, points: Tensor, times: Tensor | None) -> tuple[Tensor, Tensor | None]:
        kept = in_range(points, self._min_range_m, self._max_range_m)
        if times is not None:
            kept = kept[are_shares_of_a_period(times.index_select(0, kept))]
        return points.index_select(0, kept), None if times is None else times.index_select(0, kept)

    def _start_map(self, scan: SampledScan) -> Health:
        """Start a map with a scan, at the origin or, after a loss, where constant velocity puts it."""
        if self._frames:
            self._move(self._last_motion)
        if not self._has_enough_points(scan):
            return self._unregistered(scan, "start", "coasted")
        self._backend.local_map.update(scan.deskewed(self._last_motion), self._T_world_lidar)
        self._first_scan = _FirstScan(scan, self._T_world_lidar)
        self._coasted = 0
        return self._unregistered(scan, "start", "restarted" if self._frames else "ok")

    def _register_second_scan(self, scan: SampledScan, first: "_FirstScan", guess: Guess) -> Health:
        """Register a map's second scan, trying many motions, as there is no last one to predict from."""
        if self._recovery:
            motion = self._search(scan, start_motions(guess.T_previous_new))
            guess = Guess(motion, "start", _CLOSE_GUESS_ERROR_M)
        if first.scan.times is not None:
            self._deskew_first_scan(first, scan, guess)
        return self._register_and_update(scan, guess)

    def _deskew_first_scan(self, first: "_FirstScan", scan: SampledScan, guess: Guess) -> None:
        """Deskew the map's first scan once the motion is known; its distortion would affect every later pose."""
        attempt = self._register(scan, guess)
        if self._judgement.accepts(attempt.result):
            points = first.scan.deskewed(self._motion_per_period(attempt.T_previous_new))
            self._backend.local_map.restart()
            self._backend.local_map.update(points, first.T_world_lidar)

    def _register_and_update(self, scan: SampledScan, guess: Guess) -> Health:
        """Register a scan, again from other motions if in doubt, and add it to the map; coast if none is acceptable."""
        status: Status = "ok"
        attempt = self._register(scan, guess)
        if self._recovery and not self._is_starting and self._is_doubtful(attempt):
            attempt, status = self._recover(scan, attempt), "recovered"
        if self._judgement.accepts(attempt.result):
            self._update(scan, guess, attempt)
        else:
            status = "coasted"
            self._coast()
        return attempt.health(self._frames, len(scan.queries), status)

    def _register(self, scan: SampledScan, guess: Guess) -> Attempt:
        result = self._backend.register(
            scan, guess.T_previous_new, self._T_world_lidar, guess.error_m, self._motion_per_period
        )
        motion = se3.orthonormalize(torch.linalg.solve(self._T_world_lidar, result.T_world_lidar))
        deviation = se3.motion_difference(self._last_motion, motion)
        min_information = max(self._judgement.min_information, self._backend.registration.min_information)
        return Attempt(
            guess,
            result,
            motion,
            deviation,
            is_implausible=not self._is_starting and not self._judgement.is_plausible(deviation),
            is_degenerate=result.information[0].item() < min_information,
        )

    def _is_doubtful(self, attempt: Attempt) -> bool:
        if attempt.is_implausible or not self._judgement.accepts(attempt.result):
            return True
        if self._judgement.has_dropped(attempt.result, self._accepted):
            return True
        # Along a degenerate direction the guess remains.
        guessed = se3.motion_difference(self._last_motion, attempt.guess.T_previous_new)
        return attempt.is_degenerate and not self._judgement.is_plausible(guessed)

    def _recover(self, scan: SampledScan, doubtful: Attempt) -> Attempt:
        """The most credible of a doubtful registration, one from the last motion and one from the best of several."""
        attempts, T_guess = [doubtful], doubtful.guess.T_previous_new
        if not torch.equal(T_guess, self._last_motion):
            attempts.append(self._register(scan, Guess(self._last_motion, "recovery", _CLOSE_GUESS_ERROR_M)))
        if self._is_doubtful(attempts[-1]):
            motion = self._search(scan, surprise_motions(T_guess, self._last_motion))
            attempts.append(self._register(scan, Guess(motion, "recovery", _CLOSE_GUESS_ERROR_M)))
        return max(attempts, key=lambda attempt: self._credibility(scan, attempt))

    def _credibility(self, scan: SampledScan, attempt: Attempt) -> float:
        agreement = self._backend.agreement(scan, attempt.T_previous_new, self._T_world_lidar)
        return self._judgement.credibility(agreement, attempt.deviation)

    def _search(self, scan: SampledScan, guesses: Float[Tensor, "h 4 4"]) -> Tensor:
        """The most credible of the motions that several guesses lead to."""
        # A deskewed scan would not fit a map that is not deskewed itself.
        deskews = not self._is_starting
        motions, agreements = self._backend.register_hypotheses(scan, guesses, self._T_world_lidar, deskews)
        if self._is_starting:  # no last motion to compare with
            return motions[agreements.argmax()]
        deviations = [se3.motion_difference(self._last_motion, motion) for motion in motions]
        credibilities = map(self._judgement.credibility, agreements.tolist(), deviations)
        return motions[torch.tensor(list(credibilities)).argmax()]

    def _update(self, scan: SampledScan, guess: Guess, attempt: Attempt) -> None:
        """Move as registered, and add the scan to the map."""
        self._accepted.append(attempt.result)
        self._guess_errors_m.append(_guess_error_m(scan, guess.T_previous_new, attempt.T_previous_new))
        self._accept_motion(attempt)
        self._backend.local_map.update(scan.deskewed(self._last_motion, attempt.result.skew), self._T_world_lidar)
        self._first_scan = None
        self._coasted = 0

    def _accept_motion(self, attempt: Attempt) -> None:
        """Move, and predict the next motion from this one if it is plausible or seen twice in a row."""
        motion = attempt.T_previous_new
        motion_per_period = self._motion_per_period(motion)
        self._move(motion)
        doubted, self._doubted_motion = self._doubted_motion, None
        confirmed = doubted is not None and self._judgement.is_plausible(se3.motion_difference(doubted, motion))
        if not attempt.is_implausible or confirmed:
            self._last_motion = motion_per_period
        else:
            self._doubted_motion = motion

    def _motion_per_period(self, motion: Tensor) -> Tensor:
        """The motion over one scan period, from that since the previous pose.

        They differ if scans were lost right after a map's first one: their poses are predicted without a known motion,
        so the motion since the first scan is spread evenly.
        """
        if self._first_scan is None or not self._coasted:
            return motion
        T_first_new = torch.linalg.solve(self._first_scan.T_world_lidar, self._T_world_lidar @ motion)
        return se3.exp(se3.log(T_first_new) / (1 + self._coasted))

    def _coast(self) -> None:
        """Move as before; after too many scans in a row, clear the map, so that the next scan starts a new one."""
        self._move(self._last_motion)
        self._coasted += 1
        if self._coasted >= self._judgement.restart_after:
            self._backend.local_map.restart()

    def _move(self, motion: Tensor) -> None:
        self._T_world_lidar = se3.orthonormalize(self._T_world_lidar @ motion)

    def _unregistered(self, scan: SampledScan, source: str, status: Status) -> Health:
        return Health(self._frames, status, source, len(scan.queries))

    def _has_enough_points(self, scan: SampledScan) -> bool:
        return len(scan.queries) >= self._judgement.min_points


@dataclass(frozen=True)
class _FirstScan:
    """The first scan of a map, as measured, and its pose."""

    scan: SampledScan
    T_world_lidar: Float[Tensor, "4 4"]


def _guess_error_m(scan: SampledScan, T_guess: Tensor, T_previous_new: Tensor) -> float:
    """How far a guess put a point at the mean range from where it is registered [m]."""
    error = se3.motion_difference(T_guess, T_previous_new)
    return error.distance_m + math.radians(error.angle_deg) * scan.mean_range_m
