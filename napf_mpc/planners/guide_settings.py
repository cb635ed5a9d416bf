"""What guidance weighs against what."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from napf_mpc.constraints.passage import PassageMargins
from napf_mpc.planners.guide_lattice import Lattice
from napf_mpc.planners.guide_prices import Prices
from napf_mpc.planners.guide_search import Search

FINE = 2
"""Stations of a profile for one of the finer lattice."""


@dataclass(frozen=True)
class GuidanceSettings:
    """What guidance weighs against what; one set for all scenes, see :meth:`at_speed`."""

    usual_mps: float = 4.0
    """Lengths along the path are for formation speeds up to this; beyond, they grow with the speed [m/s]."""
    period_s: float = 0.4
    """Time between plans [s]."""
    ahead_m: float = 48.0
    """How far it looks [m]."""
    step_m: float = 2.0
    """Distance between stations of the lattice [m]."""
    cell_m: float = 1.0
    """Width of a lateral cell [m]."""
    widest_m: float = 30.0
    """Largest lateral offset [m], ..."""
    farthest_m: float = 60.0
    """... and where no other way leads past something as wide as ``large_m`` [m]."""
    large_m: float = 20.0
    """See there [m]."""
    layer_m: float = 2.0
    """Height of a layer [m]."""
    highest_m: float = 16.0
    """Highest climb over what stands on the ground [m]."""
    sphere_layers: int = 8
    """Layers to pass spheres, half of them up and half down."""
    lowest_m: float = 10.0
    """Deepest way under what hangs in the air, where it is known that no ground is [m]."""
    wide_m: float = 6.0
    """With radius, spare and margin beyond this, cells and layers are twice as large, and reach farther."""
    path: float = 8.5
    """Price of a squared offset from the lane [1/m^2 per metre of path]."""
    wide_path: float = 3.8
    """The same with margins that take the wide lattice [1/m^2 per metre]."""
    shape: float = 9.0
    """Price of a squared difference to the mean of all offsets [1/m^2 per metre]."""
    far_m: float = 12.0
    """Offsets beyond this are priced linearly [m]."""
    slope: float = 8.0
    """Price of a squared slope [per metre]."""
    steep: float = 0.7
    """Slope from which that price rises with the slope's fourth power, ..."""
    steep_far: float = 0.25
    """... and the same for offsets aside beyond ``gentle_m``. Far out every metre is dear, so a wide detour
    would be left for last, at the steepest slope there is, and be too late; so it is planned gently."""
    gentle_m: float = 5.5
    """See ``steep_far`` [m]."""
    bend: float = 10.0
    """Price of a squared change of slope per metre [m^2 per metre]."""
    keep: float = 1.0
    """Price of a squared difference to the last profile [1/m^2 per metre]."""
    keep_m: float = 4.0
    """Differences beyond this cost no more: another side may be taken if it is clearly cheaper [m]."""
    spare_m: float = 0.5
    """Distance kept beyond radius and k sigma, where there is room [m]."""
    spare: float = 200.0
    """Price of a squared lack of spare [1/m^2 per metre]."""
    breach: float = 6500.0
    """Price of a lack of margin [1/m per metre]."""
    start: float = 30.0
    """Price of a squared distance of the start from where the UAV is, where something is near [1/m^2]."""
    apart: float = 100.0
    """Price of a squared lack of separation between UAVs [1/m^2 per metre]."""
    sky_share: float = 0.5
    """Better sky gains, and worse costs, at most this share of the price of a breach by the tolerance."""
    apart_share: float = 0.6
    """Separation asked for is at most this share of the two slots' distance."""
    passes: int = 10
    """Passes of smoothing."""
    pass_m: float = 0.7
    """Largest step of a pass [m]."""
    shared_gain: float = 0.9
    """One way for all is taken if it costs less than this share of individual ways."""
    taut_slope: float = 0.35
    """Slope at which a way that was pulled taut leads back to where it must be kept."""
    taut_m: float = 15.0
    """A way on the far lattice is drawn this far at most. Behind the end of a long wall nothing holds it, and
    a lane 40 m away pulls at a UAV so hard that it cuts the corner [m]."""
    flown_slope: float = 1.4
    """Slope that is flown at full pace."""
    bend_m: float = 6.0
    """Distance over which steeper pieces are slowed down for [m]."""
    tolerance_m: float = 0.2
    """Breach from which a way counts as blocked [m]."""
    usual_margin_m: float = 2.5
    """Tolerance and squeeze are for margins k sigma up to this [m]; beyond, they grow with its power ..."""
    tolerance_power: float = 1.8
    """... of this: with margins of ten metres an estimate wanders by more than what counts with two."""
    measured_k: float = 4.0
    """On raw measurements they are those of this k at least: a small k makes no estimate steadier."""
    stop_m: float = 4.0
    """Distance to a blocked place at which the formation holds [m]."""
    slow_m: float = 5.0
    """It slows over this distance before [m]."""
    release_m: float = 2.0
    """A hold ends when the blocked place is this much farther away [m]."""
    aside: float = 20.0
    """Price of a metre aside or up on the spot, while holding."""
    aside_after_s: float = 2.0
    """A hold of this length lets UAVs look for a way aside on the spot [s]."""
    squeeze_m: float = 0.8
    """Breach that is accepted after a hold, and announced; 0 for never [m]."""
    squeeze_after_s: float = 4.0
    """Length of that hold [s]."""
    aside_m: float = 1.5
    """A UAV this far off its guide is waited for while the others hold [m]."""
    hold_limit_s: float = 40.0
    """A hold of this length is the end: no passage [s]."""
    memory_s: float = 15.0
    """Time constant with which the mean of raw measurements' sigmas forgets [s]."""
    left_behind_m: float = 3.0
    """A UAV this far behind its slot, with two sigma to that, is waited for [m]."""

    def at_speed(self, speed_mps: float) -> GuidanceSettings:
        """The same for a speed [m/s]: beyond ``usual_mps`` ways are as much longer, not as much steeper.

        Who is faster needs the time that others need to go aside and to brake. All lengths along the path are
        multiplied by one number and slopes divided by it; prices are such that the same ways stay cheapest.
        """
        scale = speed_mps / self.usual_mps
        if scale <= 1.0:
            return self
        return replace(
            self,
            ahead_m=self.ahead_m * scale,
            step_m=self.step_m * scale,
            bend_m=self.bend_m * scale,
            stop_m=self.stop_m * scale,
            slow_m=self.slow_m * scale,
            release_m=self.release_m * scale,
            left_behind_m=self.left_behind_m * scale,
            steep=self.steep / scale,
            steep_far=self.steep_far / scale,
            taut_slope=self.taut_slope / scale,
            flown_slope=self.flown_slope / scale,
            slope=self.slope * scale**2,
            bend=self.bend * scale**4,
        )


@dataclass(frozen=True)
class HeightRoom:
    """How far all UAVs may leave their lanes upwards and downwards."""

    up_m: float = math.inf
    """Within the altitude band [m]."""
    down_m: float = math.inf
    """The same."""
    ground_m: float = math.inf
    """To the ground, infinite if none is known [m]."""


ANY_HEIGHT = HeightRoom()


def _lattice(settings: GuidanceSettings, scale: int, room: HeightRoom) -> Lattice:
    step, layer = settings.step_m * scale, settings.layer_m * scale
    up, down = (max(0, math.floor(min(most, 1e6) / layer)) for most in (room.up_m, room.down_m))
    # Nobody goes under anything where nothing says what is there.
    lowest = 0.0 if min(room.down_m, room.ground_m) == math.inf else settings.lowest_m
    return Lattice(
        round(settings.ahead_m / step) + 1,
        step,
        FINE * scale,
        round(settings.widest_m / settings.cell_m),
        settings.cell_m * scale,
        layer,
        min(round(settings.highest_m / layer), up),
        min(settings.sphere_layers, 2 * min(up, down)),
        min(round(lowest / layer), down),
    )


def _prices(settings: GuidanceSettings, scale: int, open_sky_weight: float) -> Prices:
    """Prices with all lengths a number of times as long: the same shapes, only larger."""
    path = settings.path if scale == 1 else settings.wide_path
    prices = (
        path,
        settings.shape,
        settings.far_m * scale,
        settings.slope * scale**2,
        settings.steep,
        settings.steep_far,
        settings.gentle_m * scale,
        settings.bend * scale**4,
        settings.keep,
        settings.keep_m,
        settings.spare,
        settings.breach,
        settings.spare_m,
        settings.tolerance_m,
        settings.aside,
        settings.start,
        settings.apart,
        open_sky_weight * path,
        settings.sky_share * settings.breach * settings.tolerance_m,
    )
    # A whole number is a number too, but to the compiled search another type.
    return Prices(*map(float, prices))


def search_of(
    settings: GuidanceSettings,
    margins: PassageMargins,
    radius_m: float,
    open_sky_weight: float = 0.0,
    room: HeightRoom = ANY_HEIGHT,
) -> Search:
    """Settings in the form that the compiled search reads.

    Parameters
    ----------
    settings : GuidanceSettings
        At the formation's speed.
    margins : PassageMargins
        Sigmas to keep.
    radius_m : float
        Of a UAV [m].
    open_sky_weight : float
        What a squared metre of a fix's variance costs, in squared metres of offset.
    room : HeightRoom, optional
        Limits to climbing and sinking.
    """
    lattice = _lattice(settings, 1, room)
    return Search(
        lattice,
        lattice._replace(half=max(lattice.half, round(settings.farthest_m / settings.cell_m))),
        _lattice(settings, 2, room),
        settings.wide_m,
        _prices(settings, 1, open_sky_weight),
        _prices(settings, 2, open_sky_weight),
        margins,
        radius_m,
        settings.large_m,
        room.ground_m,
        settings.passes,
        settings.pass_m,
        settings.shared_gain,
    )
