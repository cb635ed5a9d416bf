"""Profiles of a whole formation: each UAV's own way blended with one for all (one run, compiled).

Two drafts are made on the lattice: every UAV for itself, drawn to the mean of what the others flew last, and
all with one profile. Both are smoothed together, where the mean is what the UAVs really do, and the cheaper
one is kept: a lone obstacle moves one UAV, a wall moves all.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napf_mpc.constraints.passage import PassageMargins
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.planners.guide_band import (
    Band,
    add_neighbour,
    add_row,
    band_price,
    mend,
    smooth_terms,
    solve_band,
    take_solids,
)
from napf_mpc.planners.guide_clearance import (
    COLUMNS,
    ENDLESS_M,
    Frame,
    Sight,
    SolidBoxes,
    gather,
    largest_reach,
    look,
    vertical_room,
)
from napf_mpc.planners.guide_lattice import Lattice, any_short, cover, list_here
from napf_mpc.planners.guide_prices import Prices, Query, bend_offsets, price_ahead
from napf_mpc.planners.guide_profile import HALO, LAYER_HALO, Bench, cheapest_profile
from napf_mpc.planners.guide_sky import SkyField, add_sky, draws, keep_for_sky, price_sky, sky_price
from napf_mpc.world.distance import Solids

Array = NDArray[np.float64]

PUSH = 2500.0
"""Price of a squared shortfall in the band [1/m^2]: what is left of it is a few centimetres."""
TIGHT_M = 10.0
"""A profile starts where the UAV is if something is in the way over this distance."""
AWAY_M = 0.5
"""A UAV whose lane is free, and whose last profile was this near to it, needs no search."""
MOST_SOLIDS = 512
"""Solids that one UAV's look-ahead takes into account."""


class Search(NamedTuple):
    """Settings of the search."""

    lattice: Lattice
    far: Lattice  # the same, farther to the sides
    wide: Lattice  # coarser and farther to the sides, for large margins
    wide_m: float  # radius and margin from which that is used
    prices: Prices
    wide_prices: Prices  # of the coarser lattice
    margins: PassageMargins  # sigmas to keep
    radius_m: float
    large_m: float  # width of what may take the wide lattice to get past [m]
    ground_room_m: float  # of the lowest lane above the ground, infinite if none is known [m]
    passes: int
    pass_m: float  # largest step of a pass [m]
    shared_gain: float  # the common draft must be cheaper by this factor


@compiled_bare
def resample(profile: Array, shift_m: float, step_m: float, out: Array) -> None:
    """Profile (station, channel) as seen ``shift_m`` farther along; its ends go on beyond."""
    stations = profile.shape[0]
    for s in range(stations):
        at = min(max(s + shift_m / step_m, 0.0), stations - 1.0)
        lower = min(int(at), stations - 2)
        part = at - lower
        for a in range(profile.shape[1]):
            out[s, a] = (1.0 - part) * profile[lower, a] + part * profile[lower + 1, a]


@compiled_bare
def mean_profile(profiles: Array, mean: Array) -> None:
    """Mean (station, 2) over UAVs of profiles (uav, station, 2), in place."""
    uavs = profiles.shape[0]
    for s in range(profiles.shape[1]):
        for a in range(2):
            total = 0.0
            for i in range(uavs):
                total += profiles[i, s, a]
            mean[s, a] = total / uavs


@compiled_bare
def _refine(coarse: Array, every: int, fine: Array) -> None:
    for s in range(fine.shape[0]):
        lower = min(s // every, coarse.shape[0] - 2)
        part = s / every - lower
        for a in range(2):
            fine[s, a] = (1.0 - part) * coarse[lower, a] + part * coarse[lower + 1, a]


@compiled_bare
def _blocked(sight: Sight, i: int, lattice: Lattice, below: int) -> bool:
    """Whether anything is short on a UAV's lane."""
    for s in range(lattice.stations):
        if sight.here_count[i, s] == 0:
            continue
        cover(sight, i, lattice, below, s, below, below, lattice.half, lattice.half)
        if sight.missing[i, s, below, lattice.half] > 0.0:
            return True
    return False


@compiled_bare
def _tight(
    sight: Sight, i: int, offset: Array, last: Array, lattice: Lattice, below: int, layers: int
) -> bool:
    """Whether something is short over the next metres between the UAV, its lane and its last profile."""
    layer = min(max(round(offset[1] / lattice.layer_m) + below, 0), layers - 1)
    low = min(offset[0], min(last[0], 0.0)) - 1.0
    high = max(offset[0], max(last[0], 0.0)) + 1.0
    c0 = max(0, int(np.floor(low / lattice.cell_m)) + lattice.half)
    c1 = min(2 * lattice.half, int(np.ceil(high / lattice.cell_m)) + lattice.half)
    if c1 < c0:
        return False
    for s in range(int(np.ceil(TIGHT_M / lattice.step_m))):
        if sight.here_count[i, s] == 0:
            continue
        cover(sight, i, lattice, below, s, layer, layer, c0, c1)
        for c in range(c0, c1 + 1):
            if sight.missing[i, s, layer, c] > 0.0:
                return True
    return False


class Scratch(NamedTuple):
    """What planning one run after the other writes over."""

    found: NDArray[np.int64]
    solid_count: NDArray[np.int64]
    reach: Array
    turned: Array
    near: Array
    here: NDArray[np.int64]
    here_count: NDArray[np.int64]
    missing: Array
    known: NDArray[np.int64]
    sky: Array
    bench: Bench
    band: Band


def make_scratch(uavs: int, fine: int, most: int, search: Search) -> Scratch:
    """Scratch for runs of so many UAVs that see so many solids each, with room for both lattices."""
    first = search.far
    wide = search.wide
    stations = max(first.stations, wide.stations)
    cells = 2 * max(first.half, wide.half) + 1
    layers = 1 + max(
        first.layers + first.under, first.sphere_layers, wide.layers + wide.under, wide.sphere_layers
    )
    return Scratch(
        np.empty((uavs, most), dtype=np.int64),
        np.empty(uavs, dtype=np.int64),
        np.empty(uavs),
        np.empty((uavs, 3, 3)),
        np.empty((uavs, most, COLUMNS)),
        np.empty((uavs, stations, most), dtype=np.int64),
        np.empty((uavs, stations), dtype=np.int64),
        np.empty((uavs, stations, layers, cells)),
        np.empty((uavs, stations, layers, 2), dtype=np.int64),
        np.empty((uavs, stations, layers, cells)),
        Bench(
            np.empty((stations, layers + 2 * LAYER_HALO, cells + 2 * HALO)),
            np.empty((layers, cells)),
            np.empty((layers, cells)),
            np.empty(stations),
            np.empty((2, layers + 2, 2), dtype=np.int64),
        ),
        Band(
            np.empty((fine, 3)),
            np.empty(fine),
            np.empty(fine),
            np.empty((fine, 2)),
            np.empty((fine, 3)),
            np.empty((fine, 4)),
        ),
    )


@compiled
def _plan_on(
    solids: Solids,
    boxes: SolidBoxes,
    first: int,
    stop: int,
    frame: Frame,
    field: SkyField,
    run: int,
    along: Array,
    offset: Array,
    lanes: Array,
    covariance: Array,
    separation: Array,
    last: Array,
    stuck: bool,
    search: Search,
    lattice: Lattice,
    prices: Prices,
    profiles: Array,
    missing: Array,
    kept: Array,
    paid: Array,
    scratch: Scratch,
) -> bool:
    """Plan the profiles of one run's UAVs on one lattice.

    Parameters
    ----------
    solids, boxes, first, stop
        The scene: solids ``first`` to ``stop - 1``.
    frame : Frame
        The path's frame.
    field, run : SkyField, int
        What to expect of fixes, and whose row of it; read only with a price of the sky.
    along, offset : array, shape (uav,), (uav, 2)
        Where UAVs are: along the path, left and up of their lanes [m].
    lanes : array, shape (uav, 2)
        Lanes: left and up [m].
    covariance : array, shape (uav, 3, 3)
        Of the position [m^2].
    separation : array, shape (uav, uav)
        Distances to keep between UAVs [m].
    last : array, shape (uav, station, 2)
        Last profiles, from where the UAVs are now [m].
    stuck : bool
        Whether the formation stands before something: then UAVs may also go aside on the spot.
    search, lattice, prices : Search, Lattice and Prices
        Settings, and those of the lattice.
    profiles, missing : array, shape (uav, station, 2), (uav, station)
        Written: profiles, and their shortfalls [m].
    kept : array, shape (uav, station)
        Written with a price of the sky only: how far from the lane it is best to stay [m].
    paid : array, shape (uav + 1, 2)
        Updated: prices of the cheapest profiles found last, each UAV's and last the one for all, by draft;
        zero for none.
    scratch : Scratch
        Written over.

    Returns
    -------
    bool
        Whether anything was in the way of the lanes or of the last profiles, or drew UAVs off them.
    """
    aside = prices.aside if stuck else -1.0
    uavs, fine, _ = profiles.shape
    need = search.radius_m + prices.spare_m
    step = lattice.step_m / lattice.fine
    span = lattice.half * lattice.cell_m
    ahead = (lattice.stations - 1) * lattice.step_m
    found, count, reach = scratch.found, scratch.solid_count, scratch.reach
    upwards = False
    over_all = spheres = True
    farthest = 0.0
    down = np.inf
    for i in range(uavs):
        reach[i] = largest_reach(covariance[i], search.margins.k, need)
        farthest = max(farthest, reach[i])
        count[i] = gather(
            boxes, first, stop, along[i] - 1.0, along[i] + ahead, lanes[i, 0] - span, lanes[i, 0] + span,
            reach[i], found[i],
        )  # fmt: skip
        up, alike, depth = vertical_room(
            solids, boxes, found[i], count[i], lanes[i, 1], reach[i], lattice.layers * lattice.layer_m
        )
        upwards = upwards or up
        over_all = over_all and (up or count[i] == 0)
        spheres = spheres and alike
        down = min(down, depth)
    to_ground = int(min(max(search.ground_room_m - farthest, 0.0), ENDLESS_M) / lattice.layer_m)
    # Past spheres down is as good as up; past what stands on the ground there is no down, ...
    below = min(lattice.sphere_layers // 2, to_ground)
    helps = over_all if upwards else down <= below * lattice.layer_m
    if spheres and below > 0 and helps:
        layers = 1 + 2 * below
    else:
        # ... unless something hangs in the air, so near that it is known that no ground is below.
        below = min(lattice.under, to_ground)
        if down > below * lattice.layer_m:
            below = 0
        layers = 1 + below + (lattice.layers if upwards else 0)
    mean = np.empty((fine, 2))
    sight = Sight(
        solids, frame, search.margins, search.radius_m, need, along, lanes, covariance, scratch.turned, reach,
        found, count, scratch.near, scratch.here, scratch.here_count, scratch.missing, scratch.known,
        prices.sky > 0.0 and prices.sky_most > 0.0,
        scratch.sky,
    )  # fmt: skip
    in_the_way = 0
    drawn = 0
    moved = False
    is_short = np.zeros(uavs, dtype=np.bool_)
    tight = np.zeros(uavs, dtype=np.bool_)
    away = np.zeros(uavs, dtype=np.bool_)
    for i in range(uavs):
        for s in range(fine):
            moved = moved or abs(last[i, s, 0]) > 1e-3 or abs(last[i, s, 1]) > 1e-3
    for i in range(uavs):
        look(sight, boxes, i)
        list_here(sight, i, lattice)
        if count[i] == 0:
            continue
        blocked = _blocked(sight, i, lattice, below)
        is_short[i] = blocked or any_short(sight, i, lattice, below, layers)
        if is_short[i]:
            in_the_way += blocked
            away[i] = blocked
            for s in range(fine):
                away[i] = away[i] or abs(last[i, s, 0]) > AWAY_M or abs(last[i, s, 1]) > AWAY_M
            tight[i] = _tight(sight, i, offset[i], last[i, 0], lattice, below, layers)
    if sight.has_sky:
        for i in range(uavs):
            worst = price_sky(field, run, along[i], lanes[i], lattice, below, layers, prices, sight.sky[i])
            wanted = draws(worst, prices)
            drawn += wanted
            away[i] = away[i] or wanted
        kept[:] = 0.0
    if in_the_way == 0 and drawn == 0 and not moved:
        profiles[:] = 0.0
        missing[:] = 0.0
        return False
    bench = scratch.bench
    band = scratch.band
    bend_offsets(lattice, below, layers, prices, bench.bend)
    price_ahead(lattice, prices.path, prices.slope, bench.ahead)
    coarse = np.zeros((uavs, lattice.stations, 2))
    mean_profile(last, mean)
    draft_mean = np.empty((fine, 2))
    start = offset.copy()
    middle = np.zeros(2)
    for i in range(uavs):
        middle += offset[i] / uavs
    best = np.inf
    trial = np.empty((uavs, fine, 2))
    drafts = np.empty((uavs, fine, 2))
    trial_missing = np.empty((uavs, fine))
    for draft in range(2):
        draft_mean[:] = mean
        if draft == 1 and drawn < 2 and (in_the_way < 2 or missing.max() <= prices.spare_m):
            # One way for all never was cheaper where each had found its own.
            break
        # In the second draft the way for all comes first, and draws the others.
        for i in range(-draft, uavs):
            shared = i < 0
            if not shared and not away[i]:
                coarse[i] = 0.0
                trial[i] = 0.0
                continue
            crowded = False
            for j in range(i):
                crowded = crowded or abs(along[i] - along[j]) < separation[i, j]
            query = Query(
                0 if shared else i, uavs if shared else i + 1, 0.0 if shared else prices.shape, draft_mean,
                last, coarse, separation, crowded, aside,
            )  # fmt: skip
            chosen, own = coarse[max(i, 0)], uavs if shared else i
            paid[own, draft] = cheapest_profile(
                sight, lattice, below, layers, prices, query, bench, middle if shared else offset[i],
                paid[own, draft], chosen,
            )  # fmt: skip
            if shared:
                _refine(chosen, lattice.fine, draft_mean)
                continue
            _refine(chosen, lattice.fine, trial[i])
            # Who reaches farther than a step has been asked about all there is in between.
            if is_short[i] and reach[i] < lattice.step_m:
                mend(sight, i, chosen, lattice.fine, step, trial[i])
            for a in range(2):
                start[i, a] = offset[i, a]
                if stuck and abs(chosen[0, a] - offset[i, a]) > lattice.cell_m:
                    start[i, a] = chosen[0, a]
        drafts[:] = trial
        for _ in range(search.passes):
            mean_profile(trial, draft_mean)
            for i in range(uavs):
                smooth_terms(trial[i], draft_mean, last[i], step, prices, band)
                if tight[i]:
                    add_row(band.own, band.right, 0, prices.start, 1.0, 0.0, start[i, 0])
                    add_row(band.own, band.right, 0, prices.start, 0.0, 1.0, start[i, 1])
                elif drawn > 0 and not stuck:
                    # Where nothing stands near, nothing else holds the start: it would jump to the best sky.
                    add_row(band.own, band.right, 0, PUSH, 1.0, 0.0, last[i, 0, 0])
                    add_row(band.own, band.right, 0, PUSH, 0.0, 1.0, last[i, 0, 1])
                if sight.has_sky:
                    add_sky(sight.sky[i], lattice, below, layers, step, trial[i], band.own, band.right)
                if is_short[i]:
                    take_solids(
                        sight, i, step, PUSH, layers == 1, drafts[i], trial[i], band, trial_missing[i]
                    )
                for j in range(uavs):
                    if j != i and abs(along[i] - along[j]) < separation[i, j]:
                        add_neighbour(
                            along[i] - along[j], lanes[i] - lanes[j], separation[i, j], trial[j], step,
                            prices.apart, trial[i], band,
                        )  # fmt: skip
                solve_band(band)
                for s in range(fine):
                    for a in range(2):
                        # A longer step could jump across what the draft goes round.
                        change = band.right[s, a] - trial[i, s, a]
                        trial[i, s, a] += min(max(change, -search.pass_m), search.pass_m)
        for i in range(uavs):
            take_solids(sight, i, step, 0.0, layers == 1, drafts[i], trial[i], band, trial_missing[i])
        mean_profile(trial, draft_mean)
        price = band_price(trial, draft_mean, last, trial_missing, step, prices)
        if sight.has_sky:
            for i in range(uavs):
                for s in range(fine):
                    at = sky_price(sight.sky[i], lattice, below, layers, s, trial[i, s, 0], trial[i, s, 1])
                    price += step * at
        if draft == 0 or price < search.shared_gain * best:
            best = price
            profiles[:] = trial
            missing[:] = trial_missing
    if sight.has_sky:
        for i in range(uavs):
            keep_for_sky(sight.sky[i], lattice, below, layers, prices, profiles[i], kept[i])
    return True


@compiled_bare
def _large_ahead(boxes: SolidBoxes, scratch: Scratch, large_m: float) -> bool:
    """Whether any UAV has found something of such a width."""
    for i in range(scratch.found.shape[0]):
        for entry in range(scratch.solid_count[i]):
            solid = scratch.found[i, entry]
            if boxes.high[solid, 1] - boxes.low[solid, 1] >= large_m:
                return True
    return False


@compiled_bare
def _farthest_aside(offset: Array, last: Array) -> float:
    """Largest distance aside of UAVs (uav, 2) and their last profiles (uav, station, 2) [m]."""
    farthest = 0.0
    for i in range(offset.shape[0]):
        farthest = max(farthest, abs(offset[i, 0]))
        for s in range(last.shape[1]):
            farthest = max(farthest, abs(last[i, s, 0]))
    return farthest


@compiled
def plan_run(
    solids: Solids,
    boxes: SolidBoxes,
    first: int,
    stop: int,
    frame: Frame,
    field: SkyField,
    run: int,
    along: Array,
    offset: Array,
    lanes: Array,
    covariance: Array,
    separation: Array,
    last: Array,
    stuck: bool,
    search: Search,
    profiles: Array,
    missing: Array,
    kept: Array,
    paid: Array,
    scratch: Scratch,
    far: bool,
) -> tuple[bool, bool]:
    """Plan the profiles of one run's UAVs on the lattice that they need, see :func:`_plan_on`.

    That is the wide one for large margins, and the far one for what is large and leaves no way open on the
    usual one.

    Parameters
    ----------
    far : bool
        Whether the last plan took the far lattice.
    ... :
        As for :func:`_plan_on`.

    Returns
    -------
    busy, far : bool
        Whether anything was in the way, and whether this plan took the far lattice.
    """
    lattice, prices = search.lattice, search.prices
    need = search.radius_m + prices.spare_m
    for i in range(len(along)):
        if largest_reach(covariance[i], search.margins.k, need) > search.wide_m:
            return _plan_on(
                solids, boxes, first, stop, frame, field, run, along, offset, lanes, covariance, separation,
                last, stuck, search, search.wide, search.wide_prices, profiles, missing, kept, paid, scratch,
            ), far  # fmt: skip
    # Who is far aside on the way round stays with the lattice that reaches there.
    out = far and _farthest_aside(offset, last) > 0.5 * lattice.half * lattice.cell_m
    busy = _plan_on(
        solids, boxes, first, stop, frame, field, run, along, offset, lanes, covariance, separation, last,
        stuck, search, search.far if out else lattice, prices, profiles, missing, kept, paid, scratch,
    )  # fmt: skip
    worst = missing.max()
    if out or worst <= prices.spare_m + prices.tolerance_m:
        return busy, out
    if not _large_ahead(boxes, scratch, search.large_m):
        return busy, False
    near = profiles.copy(), missing.copy(), kept.copy()
    _plan_on(
        solids, boxes, first, stop, frame, field, run, along, offset, lanes, covariance, separation, last,
        stuck, search, search.far, prices, profiles, missing, kept, paid, scratch,
    )  # fmt: skip
    if missing.max() < worst - prices.tolerance_m:
        return busy, True
    profiles[:], missing[:], kept[:] = near
    return busy, False


@compiled
def _plan_runs(
    solids: Solids,
    boxes: SolidBoxes,
    scene_start: NDArray[np.int64],
    frame: Frame,
    field: SkyField,
    due: NDArray[np.bool_],
    along: Array,
    offset: Array,
    lanes: Array,
    covariance: Array,
    separation: Array,
    last: Array,
    stuck: NDArray[np.bool_],
    search: Search,
    profiles: Array,
    missing: Array,
    kept: Array,
    paid: Array,
    busy: NDArray[np.bool_],
    far: NDArray[np.bool_],
    scratch: Scratch,
) -> None:
    for r in range(along.shape[0]):
        if not due[r]:
            continue
        scene = 0 if len(scene_start) == 2 else r
        busy[r], far[r] = plan_run(
            solids, boxes, scene_start[scene], scene_start[scene + 1], frame, field, r, along[r], offset[r],
            lanes, covariance[r], separation[r], last[r], stuck[r], search, profiles[r], missing[r], kept[r],
            paid[r], scratch, far[r],
        )  # fmt: skip


@compiled_bare
def _largest_scene(scene_start: NDArray[np.int64]) -> int:
    """Most solids of a scene; 0 without scenes."""
    most = 0
    for scene in range(len(scene_start) - 1):
        most = max(most, scene_start[scene + 1] - scene_start[scene])
    return most


class _Kept(threading.local):
    """Scratch of this thread, kept from plan to plan: fresh memory would cost as much as the plan."""

    def __init__(self) -> None:
        self.key: tuple[object, ...] = ()
        self.scratch: Scratch | None = None

    def of(self, uavs: int, fine: int, most: int, search: Search) -> Scratch:
        key = (uavs, fine, most, search.far, search.wide)
        if self.scratch is None or key != self.key:
            self.scratch = make_scratch(uavs, fine, most, search)
            self.key = key
        return self.scratch


_KEPT = _Kept()


def plan_all(
    solids: Solids,
    boxes: SolidBoxes,
    scene_start: NDArray[np.int64],
    frame: Frame,
    field: SkyField,
    due: NDArray[np.bool_],
    along: Array,
    offset: Array,
    lanes: Array,
    covariance: Array,
    separation: Array,
    last: Array,
    stuck: NDArray[np.bool_],
    search: Search,
    profiles: Array,
    missing: Array,
    kept: Array,
    paid: Array,
    busy: NDArray[np.bool_],
    far: NDArray[np.bool_],
) -> None:
    """Plan all runs that are due, each from its own scene and state alone; see :func:`plan_run`."""
    # Powers of two, so that scenes of different size share scratch.
    most = min(MOST_SOLIDS, 1 << max(_largest_scene(scene_start) - 1, 1).bit_length())
    _plan_runs(
        solids, boxes, scene_start, frame, field, due, along, offset, lanes, covariance, separation, last,
        stuck, search, profiles, missing, kept, paid, busy, far,
        _KEPT.of(profiles.shape[1], profiles.shape[2], most, search),
    )  # fmt: skip


@compiled
def resample_all(profiles: Array, shift_m: Array, step_m: float, out: Array) -> None:
    """Profiles (run, uav, station, channel) as seen from where the UAVs have come to, in place."""
    for r in range(profiles.shape[0]):
        for i in range(profiles.shape[1]):
            resample(profiles[r, i], shift_m[r, i], step_m, out[r, i])


@compiled
def resample_taut(
    taut: Array, loose: Array, room: Array, shift_m: Array, step_m: float, out_taut: Array, out_loose: Array,
    out_room: Array,
) -> None:  # fmt: skip
    """The same of taut ways (run, uav, station, 2), and of how loose and roomy they are (..., station)."""
    shape = (*loose.shape, 1)
    resample_all(taut, shift_m, step_m, out_taut)
    resample_all(loose.reshape(shape), shift_m, step_m, out_loose.reshape(shape))
    resample_all(room.reshape(shape), shift_m, step_m, out_room.reshape(shape))
