"""The odometry: one pose per scan, from an initialization and a registration backend."""

import math
from collections import deque
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.ranges import in_range
from lidarlearn.odometry.backend import Backend
from lidarlearn.odometry.health import Health, Status
from lidarlearn.odometry.hypotheses import start_motions, surprise_motions
from lidarlearn.odometry.initialization.base import Initialization, InitialMotion
from lidarlearn.odometry.judgement import Judgement, motion_difference
from lidarlearn.odometry.sampling import SampledScan
from lidarlearn.odometry.scan_by_scan import Frame, Points, ScanByScan, Times, are_shares_of_a_period, as_scan
from lidarlearn.registration.result import RegistrationResult

_NOT_FAR_M = 0.1  # how far off a motion may be that was found among several, or is the last one


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
        guess = self._initialization.predict(points, self._motion.clone())
        scan = self._backend.sampling.sample(points, times)
        if self._backend.local_map.association.is_empty:
            health = self._begin(scan)
        elif not self._has_enough_points(scan):
            health = self._coast(self._unregistered(scan, guess.source))
        elif self._first is not None:
            health = self._set_off(scan, self._first, guess)
        else:
            health = self._advance(scan, guess.T_previous_new, guess.source)
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
        status: Status = "ok" if self._frames == 0 else "restarted"
        if self._has_enough_points(scan):
            self._backend.local_map.update(scan.deskewed(self._motion), self._T_world_lidar)
            self._first = _Beginning(scan, self._T_world_lidar)
            self._coasting = 0
        else:
            status = "coasted"
        return replace(self._unregistered(scan, "start"), status=status)

    def _set_off(self, scan: SampledScan, first: "_Beginning", guess: InitialMotion) -> Health:
        """Register a scan to the only one there is, from motions of all kinds: none has been seen yet."""
        T_previous_new, source = guess.T_previous_new, guess.source
        if self._recovery:
            T_previous_new, source = self._search(scan, start_motions(T_previous_new)), "start"
        if first.scan.times is not None:
            self._deskew_first(first, scan, T_previous_new, source)
        return self._advance(scan, T_previous_new, source)

    def _deskew_first(self, first: "_Beginning", scan: SampledScan, T_previous_new: Tensor, source: str) -> None:
        """Compensate the first scan, too, once the motion is known: what is skewed in the map stays in the poses."""
        attempt = self._register(scan, T_previous_new, source)
        if self._judgement.accepts(attempt.result):
            self._backend.local_map.restart()
            self._backend.local_map.update(first.scan.deskewed(self._per_scan(attempt.motion)), first.T_world_lidar)

    def _advance(self, scan: SampledScan, T_previous_new: Tensor, source: str) -> Health:
        """Register a scan, from its guess and in doubt from others, or let the motion model carry on."""
        attempt = self._register(scan, T_previous_new, source)
        if self._recovery and source != "start" and self._is_doubtful(attempt):
            attempt = self._try_others(scan, attempt)
        if not self._judgement.accepts(attempt.result):
            return self._coast(attempt.health)
        self._fits.append(attempt.result.fit.item())
        self._surprises_m.append(_displacement_m(scan, T_previous_new, attempt.motion))
        self._trust(attempt.motion, attempt.health)
        self._backend.local_map.update(scan.deskewed(self._motion, attempt.result.skew), self._T_world_lidar)
        self._first = None
        self._coasting = 0
        return attempt.health

    def _try_others(self, scan: SampledScan, doubtful: "_Attempt") -> "_Attempt":
        """The most credible of a registration in doubt, one from the last motion and one from the best of many."""
        attempts = [doubtful]
        if not torch.equal(doubtful.T_guess, self._motion):
            attempts.append(self._register(scan, self._motion, "recovery"))
        if self._is_doubtful(attempts[-1]):
            guesses = surprise_motions(doubtful.T_guess, self._motion)
            attempts.append(self._register(scan, self._search(scan, guesses), "recovery"))
        best = max(attempts, key=lambda attempt: self._credibility(scan, attempt))
        return replace(best, health=replace(best.health, status="recovered"))

    def _is_doubtful(self, attempt: "_Attempt") -> bool:
        if attempt.health.implausible or not self._judgement.accepts(attempt.result):
            return True
        if attempt.result.fit.item() < self._judgement.min_fit_share * max(self._fits, default=0.0):
            return True
        # Where the map says too little, what was guessed remains.
        guessed = motion_difference(self._motion, attempt.T_guess)
        return attempt.health.degenerate and not self._judgement.is_plausible(guessed)

    def _register(self, scan: SampledScan, T_previous_new: Tensor, source: str) -> "_Attempt":
        is_searched = source in ("start", "recovery")
        surprise_m = _NOT_FAR_M if is_searched else max(self._surprises_m, default=math.inf)
        result = self._backend.register(scan, T_previous_new, self._T_world_lidar, surprise_m, self._per_scan)
        motion = se3.orthonormalize(torch.linalg.solve(self._T_world_lidar, result.T_world_lidar))
        return _Attempt(T_previous_new, result, motion, self._assess(scan, result, motion, source))

    def _credibility(self, scan: SampledScan, attempt: "_Attempt") -> float:
        agreement = self._backend.agreement(scan, attempt.motion, self._T_world_lidar)
        return self._judgement.credibility(agreement, motion_difference(self._motion, attempt.motion))

    def _search(self, scan: SampledScan, guesses: Float[Tensor, "h 4 4"]) -> Tensor:
        """The most credible of the motions that several guesses lead to."""
        is_map_skewed = self._first is not None  # a compensated scan would not fit one that is not
        motions, agreements = self._backend.register_hypotheses(scan, guesses, self._T_world_lidar, not is_map_skewed)
        if self._first is not None:
            return motions[agreements.argmax()]
        deviations = [motion_difference(self._motion, motion) for motion in motions]
        credibilities = map(self._judgement.credibility, agreements.tolist(), deviations)
        return motions[torch.tensor(list(credibilities)).argmax()]

    def _coast(self, health: Health) -> Health:
        """Move as before; after too many scans without a registration, begin a new map."""
        self._move(self._motion)
        self._coasting += 1
        if self._coasting >= self._judgement.restart_after:
            self._backend.local_map.restart()
        return replace(health, status="coasted")

    def _trust(self, motion: Tensor, health: Health) -> None:
        """Move, and take over the motion as the model of the next one if it is plausible or seen twice."""
        per_scan = self._per_scan(motion)
        self._move(motion)
        doubted, self._doubted_motion = self._doubted_motion, None
        confirmed = doubted is not None and self._judgement.is_plausible(motion_difference(doubted, motion))
        if self._first is not None or not health.implausible or confirmed:
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

    def _assess(self, scan: SampledScan, result: RegistrationResult, motion: Tensor, source: str) -> Health:
        deviation = motion_difference(self._motion, motion)
        information = result.information[0].item()
        least = max(self._judgement.min_information, self._backend.registration.min_information)
        return Health(
            frame=self._frames,
            initialization=source,
            points=len(scan.queries),
            iterations=result.iterations,
            converged=bool(result.converged),
            overlap=result.overlap.item(),
            inlier_share=result.inlier_share.item(),
            rmse_m=result.rmse_m.item(),
            skew_m=result.skew[:3].norm().item(),
            skew_deg=math.degrees(result.skew[3:].norm().item()),
            min_information=information,
            degenerate=information < least,
            weakest_direction=tuple(result.weakest_direction.tolist()),
            deviation_m=deviation.distance_m,
            deviation_deg=deviation.angle_deg,
            implausible=self._first is None and not self._judgement.is_plausible(deviation),
        )

    def _unregistered(self, scan: SampledScan, source: str) -> Health:
        return Health(self._frames, initialization=source, points=len(scan.queries))

    def _has_enough_points(self, scan: SampledScan) -> bool:
        return len(scan.queries) >= self._judgement.min_points


@dataclass(frozen=True)
class _Beginning:
    """The first scan of a map, and where it was begun."""

    scan: SampledScan
    T_world_lidar: Float[Tensor, "4 4"]


@dataclass(frozen=True)
class _Attempt:
    """A registration from a guess, the motion that it means, and what is to be thought of it."""

    T_guess: Float[Tensor, "4 4"]
    result: RegistrationResult
    motion: Float[Tensor, "4 4"]
    health: Health


def _displacement_m(scan: SampledScan, T_guess: Tensor, T_previous_new: Tensor) -> float:
    """How far a point at the mean range was from where the guess had it."""
    surprise = motion_difference(T_guess, T_previous_new)
    return surprise.distance_m + math.radians(surprise.angle_deg) * scan.mean_range_m
