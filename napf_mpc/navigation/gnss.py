r"""The emulated GNSS receiver: which signals of which satellites it has at a place, and with which errors.

The error of a pseudorange is, for satellite s and UAV i,

.. math:: \varepsilon_{is} = \underbrace{\sigma_{sis} a_s + \sigma_{ion} F(E_s)\, b_s
          + \sigma_{tro} m(E_s)\, c_s}_{\text{common to all UAVs}} + \underbrace{\sigma_n(C/N_0)\, z_{is} +
          \begin{cases} \sigma_{mp}(E_s)\, g_s(x_i, t) & \text{in sight} \\ d_s(x_i, t) & \text{reflected}
          \end{cases}}_{\text{its own}}

with a, b, c standard normal once a mission (they change over hours), z white, g a field over place and time
(:mod:`napf_mpc.navigation.wave_field`), and d >= 0 an exponential extra path that is such a field, too. A
satellite that buildings hide arrives by reflection, weaker by a loss that varies from place to place; what is
weaker than the mask is not received. The receiver knows elevation and C/N0, but not what is reflected. It
takes its sigmas from the laws above, and for reflections, which come weak, adds a sigma that grows as C/N0
falls.

The receiver's clock adds the same to all ranges of a system and is solved for, so it drops out to rounding
and is left out here. So do group delays and all that a satellite's own clock does: who is told the true
clock corrects for it, and what is wrong in what is told is the signal in space's error.
"""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napf_mpc.data_folder import find_data_file
from napf_mpc.errors import ProblemError
from napf_mpc.jit import compiled
from napf_mpc.navigation.almanac import nominal_constellation
from napf_mpc.navigation.ephemeris import SYSTEMS, BroadcastConstellation, Constellation
from napf_mpc.navigation.range_errors import (
    carrier_to_noise_dbhz,
    code_noise_sigma_m,
    multipath_sigma_m,
    obliquity,
    p_reflected,
    troposphere_mapping,
)
from napf_mpc.navigation.rinex import gps_seconds, read_rinex_navigation
from napf_mpc.navigation.sky import directions, elevation_rad
from napf_mpc.navigation.wave_field import WAVES, Waves, field_value, waves
from napf_mpc.problem import City, Gnss, World
from napf_mpc.streams import Seed, Stream, normals, uniforms
from napf_mpc.world.obstacles import ObstacleSet
from napf_mpc.world.sight import line_of_sight

__all__ = ["CLOCK_OF_SYSTEM", "GnssScene", "Observation", "gnss_scene", "origin_deg", "sky_constellation"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

CLOCK_OF_SYSTEM = np.array([0, 1, 0])
"""Receiver's clock by system: GPS, Galileo, and QZSS with that of GPS."""
DEFAULT_ORIGIN_DEG = (50.0, 10.0)
_NODE_S = 10.0  # directions turn by 2e-3 rad in it; a straight line between is right to 1e-6
_MULTIPATH, _DELAY, _LOSS = range(3)
_FIELDS = 3
_BELOW = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class Observation:
    """What receivers have at one moment; satellites that they do not have hold zeros."""

    directions: Array
    """(run, sat, 3) unit vectors to the satellites, east, north, up."""
    in_sight: Mask
    """(run, uav, sat) whether it is above the mask and nothing stands in the way."""
    tracked: Mask
    """(run, uav, sat) whether there is a pseudorange."""
    carrier_to_noise: Array
    """(run, uav, sat) C/N0 [dB Hz]."""
    error: Array
    """(run, uav, sat) pseudorange less the true range and the receiver's clock [m]."""
    sigma: Array
    """(run, uav, sat) of that error, as the receiver believes [m]."""
    shared_sigma: Array
    """(run, sat) of the part that all UAVs have in common [m]."""


@dataclass(frozen=True, eq=False)
class GnssScene:
    """Satellites, buildings and errors of a block of runs; nothing in here changes while they fly."""

    config: Gnss
    """Settings."""
    names: tuple[str, ...]
    """Satellites."""
    clock: Index
    """(sat,) which of the receiver's clocks each is measured against."""
    nodes: Array
    """(run, node, sat, 3) directions every 10 s from the start, of missing satellites straight down."""
    signal_in_space_m: Array
    """(run, sat) sigma [m]."""
    common: Array
    """(run, sat, 3) standard normal: signal in space, ionosphere, troposphere."""
    fields: Waves
    """(run, sat, field, wave): multipath, delay and loss by reflection."""
    obstacles: ObstacleSet
    """What hides satellites."""
    start_s: Array
    """(run,) GPS time since 1980-01-06 at the start [s]."""

    def directions(self, time_s: float) -> Array:
        """(run, sat, 3) unit vectors to the satellites at a time of the mission."""
        at = min(time_s / _NODE_S, self.nodes.shape[1] - 1.0)
        first = min(int(at), self.nodes.shape[1] - 2)
        share = at - first
        between = (1.0 - share) * self.nodes[:, first] + share * self.nodes[:, first + 1]
        length = np.sqrt(between[..., 0] ** 2 + between[..., 1] ** 2 + between[..., 2] ** 2)
        return np.asarray(between / length[..., None])

    def observe(self, time_s: float, position: Array, noise: Array, open_sky: bool = False) -> Observation:
        """Receive at places and a time.

        Parameters
        ----------
        time_s : float
            Time since the start of the mission [s].
        position : array, shape (run, uav, 3)
            True places [m].
        noise : array, shape (run, uav, sat)
            Standard normal, for the code noise.
        open_sky : bool
            Leave the buildings and the C/N0 mask out.
        """
        cfg = self.config
        unit, elevation, above = self._overhead(time_s)
        if open_sky:
            in_sight = np.broadcast_to(above[:, None], noise.shape).copy()
        else:
            in_sight = line_of_sight(self.obstacles, position, unit, above)
        parts = self._shared_parts(elevation)
        shared = _length(parts)
        drawn = parts * self.common
        low, high = cfg.carrier_to_noise_dbhz
        strength = np.zeros(noise.shape)
        error = np.zeros(noise.shape)
        tracked = np.zeros(noise.shape, dtype=np.bool_)
        _receive(
            np.ascontiguousarray(position), time_s, noise, above, in_sight,
            carrier_to_noise_dbhz(elevation, low, high),
            -np.inf if open_sky else cfg.carrier_to_noise_mask_dbhz,
            cfg.fading_db, cfg.reflected_loss_db, cfg.reflected_loss_sigma_db, cfg.reflected_delay_m,
            cfg.multipath_scale * multipath_sigma_m(elevation),
            np.ascontiguousarray(drawn[..., 0] + drawn[..., 1] + drawn[..., 2]),
            *self.fields, strength, error, tracked,
        )  # fmt: skip
        white = code_noise_sigma_m(strength, cfg.code_noise_m)
        # The kernel leaves the white noise to here, where its sigma is known.
        error += np.where(tracked, white * noise, 0.0)
        sigma = np.where(tracked, self.believed_sigma(unit, strength), 0.0)
        return Observation(unit, in_sight, tracked, strength, error, sigma, shared)

    def expect(self, time_s: float, position: Array) -> Observation:
        """Expect at places and a time what the map, the almanac and the laws say, and nothing that is drawn.

        A signal in sight is expected with its usual C/N0, a hidden one with that less the mean loss by
        reflection; what then is under the mask is not counted on. Errors are zero: they are not known.

        Parameters
        ----------
        time_s : float
            Time since the start of the mission [s].
        position : array, shape (run, place, 3)
            Any places [m].
        """
        cfg = self.config
        unit, elevation, above = self._overhead(time_s)
        in_sight = line_of_sight(self.obstacles, position, unit, above)
        usual = carrier_to_noise_dbhz(elevation, *cfg.carrier_to_noise_dbhz)[:, None]
        expected = np.where(in_sight, usual, usual - cfg.reflected_loss_db)
        tracked = above[:, None] & (expected >= cfg.carrier_to_noise_mask_dbhz)
        strength = np.where(tracked, expected, 0.0)
        sigma = np.where(tracked, self.believed_sigma(unit, strength), 0.0)
        shared = _length(self._shared_parts(elevation))
        return Observation(unit, in_sight, tracked, strength, np.zeros(strength.shape), sigma, shared)

    def believed_sigma(self, unit: Array, carrier_to_noise: Array) -> Array:
        """Sigma of ranges as the receiver believes, from what it knows (run, uav, sat) [m].

        Parameters
        ----------
        unit : array, shape (run, sat, 3)
            Directions of satellites.
        carrier_to_noise : array, shape (run, uav, sat)
            [dB Hz].
        """
        reflection = code_noise_sigma_m(carrier_to_noise, self.config.believed_reflection_m)
        return np.asarray(np.sqrt(self._sight_variance(unit, carrier_to_noise) + reflection**2))

    def sight_sigma(self, unit: Array, carrier_to_noise: Array) -> Array:
        """Sigma of ranges (run, uav, sat) if their signals are in sight [m]; arguments as before."""
        return np.asarray(np.sqrt(self._sight_variance(unit, carrier_to_noise)))

    def p_reflected(self, unit: Array, carrier_to_noise: Array) -> Array:
        """Probability (run, uav, sat) that signals arrive by reflection alone, by their C/N0 and elevation.

        Before its strength is known, ``prior_reflected`` for one on the horizon, which falls with the angle
        to none in the zenith; the rest are the laws of C/N0.
        """
        cfg = self.config
        low, high = cfg.carrier_to_noise_dbhz
        elevation = self._elevation(unit)
        expected = carrier_to_noise_dbhz(elevation, low, high)[:, None]
        return p_reflected(
            carrier_to_noise - expected, cfg.fading_db, cfg.reflected_loss_db, cfg.reflected_loss_sigma_db,
            cfg.prior_reflected * np.maximum(1.0 - elevation / (0.5 * math.pi), 0.0)[:, None],
        )  # fmt: skip

    def _overhead(self, time_s: float) -> tuple[Array, Array, Mask]:
        """Directions (run, sat, 3), elevations (run, sat) [rad], and who is above the mask.

        Those below count as in the zenith, where every law is defined.
        """
        unit = self.directions(time_s)
        elevation = elevation_rad(unit)
        above = elevation >= math.radians(self.config.elevation_mask_deg)
        return unit, np.where(above, elevation, 0.5 * math.pi), above

    def _elevation(self, unit: Array) -> Array:
        """Elevation (run, sat) of satellites, of those under the mask its own [rad]."""
        return np.maximum(elevation_rad(unit), math.radians(self.config.elevation_mask_deg))

    def _sight_variance(self, unit: Array, carrier_to_noise: Array) -> Array:
        elevation = self._elevation(unit)
        shared = _length(self._shared_parts(elevation))
        multipath = self.config.multipath_scale * multipath_sigma_m(elevation)
        noise = code_noise_sigma_m(carrier_to_noise, self.config.code_noise_m)
        return np.asarray((shared**2 + multipath**2)[:, None] + noise**2)

    def _shared_parts(self, elevation: Array) -> Array:
        """Sigmas (run, sat, 3) of what all UAVs have in common: signal in space, ionosphere, troposphere."""
        cfg = self.config
        return np.stack(
            [
                self.signal_in_space_m,
                cfg.ionosphere_m * obliquity(elevation),
                cfg.troposphere_m * troposphere_mapping(elevation),
            ],
            axis=-1,
        )

    def of_run(self, run: int, obstacles: ObstacleSet) -> GnssScene:
        """Return one run of the block, with its own scene."""
        rows = slice(run, run + 1)
        return replace(
            self,
            nodes=self.nodes[rows],
            signal_in_space_m=self.signal_in_space_m[rows],
            common=self.common[rows],
            fields=Waves(*(part[rows] for part in self.fields)),
            obstacles=obstacles,
            start_s=self.start_s[rows],
        )


def _length(parts: Array) -> Array:
    return np.asarray(np.sqrt(parts[..., 0] ** 2 + parts[..., 1] ** 2 + parts[..., 2] ** 2))


@compiled
def _receive(
    position: Array,
    time_s: float,
    noise: Array,
    above: Mask,
    in_sight: Mask,
    nominal_dbhz: Array,
    mask_dbhz: float,
    fading_db: float,
    loss_db: float,
    loss_sigma_db: float,
    delay_m: float,
    multipath: Array,
    common: Array,
    vector: Array,
    rate: Array,
    phase: Array,
    strength: Array,
    error: Array,
    tracked: Mask,
) -> None:
    """Write C/N0, which signals are received, and their errors without the white noise."""
    for r in range(noise.shape[0]):
        for i in range(noise.shape[1]):
            x, y, z = position[r, i, 0], position[r, i, 1], position[r, i, 2]
            for s in range(noise.shape[2]):
                if not above[r, s]:
                    continue
                g = field_value(vector[r, s, _LOSS], rate[r, s, _LOSS], phase[r, s, _LOSS], x, y, z, time_s)
                if in_sight[r, i, s]:
                    cn0 = nominal_dbhz[r, s] + fading_db * g
                else:
                    cn0 = nominal_dbhz[r, s] - max(loss_db + loss_sigma_db * g, 0.0)
                if cn0 < mask_dbhz:
                    continue
                strength[r, i, s] = cn0
                tracked[r, i, s] = True
                kind = _MULTIPATH if in_sight[r, i, s] else _DELAY
                g = field_value(vector[r, s, kind], rate[r, s, kind], phase[r, s, kind], x, y, z, time_s)
                if kind == _MULTIPATH:
                    error[r, i, s] = common[r, s] + multipath[r, s] * g
                else:
                    # From normal to exponential: -log of a uniform number.
                    tail = 0.5 * math.erfc(g / math.sqrt(2.0))
                    error[r, i, s] = common[r, s] - delay_m * math.log(tail)


def origin_deg(config: Gnss, world: World) -> tuple[float, float]:
    """Latitude and longitude of the local frame's origin: as given, else the city's, else 50, 10."""
    if config.origin_latitude_deg is not None and config.origin_longitude_deg is not None:
        return config.origin_latitude_deg, config.origin_longitude_deg
    if isinstance(world, City) and world.origin_latitude_deg is not None:
        assert world.origin_longitude_deg is not None  # they go together
        return world.origin_latitude_deg, world.origin_longitude_deg
    return DEFAULT_ORIGIN_DEG


def sky_constellation(config: Gnss, time_s: float, data_folder: Path | None) -> Constellation:
    """Satellites that a receiver may have around a GPS time [s since 1980-01-06], of all systems.

    Raises
    ------
    DataError
        The navigation file is missing or unusable.
    """
    if config.file is None:
        return nominal_constellation()
    return read_rinex_navigation(find_data_file(config.file, data_folder)).at(time_s)


def gnss_scene(
    config: Gnss,
    world: World,
    obstacles: ObstacleSet,
    seed: Seed,
    runs: range,
    duration_s: float,
    data_folder: Path | None = None,
) -> GnssScene:
    """Draw what receivers meet in a block of runs.

    Parameters
    ----------
    config : Gnss
        Settings.
    world : World
        Where the city is.
    obstacles : ObstacleSet
        Scenes of these runs, or one for all.
    seed : int or Numbers
        Campaign seed, or what stands for it.
    runs : range
        Runs of the block. What a run draws depends on its index and the seed alone.
    duration_s : float
        Time to cover [s].
    data_folder : Path, optional
        Where a navigation file is looked for.

    Raises
    ------
    DataError
        The navigation file is missing or unusable.
    ProblemError
        At a run's start too few satellites stand above the mask.
    """
    first = gps_seconds(dt.datetime.fromisoformat(config.start_gps_time))
    late = uniforms(seed, runs, Stream.GNSS_START, 1, 1, 1)[:, 0, 0, 0]
    start = first + 3600.0 * config.start_spread_h * late
    names, system = _all_satellites(config, data_folder)
    seconds = np.arange(max(2, math.ceil(duration_s / _NODE_S) + 1)) * _NODE_S
    nodes = np.tile(_BELOW, (len(runs), len(seconds), len(names), 1))
    sigma = np.full((len(runs), len(names)), config.signal_in_space_m)
    latitude, longitude = origin_deg(config, world)
    place_of = {name: n for n, name in enumerate(names)}
    for r in range(len(runs)):
        constellation = sky_constellation(config, float(start[r]), data_folder)
        rows = [n for n, name in enumerate(constellation.names) if name in place_of]
        columns = [place_of[constellation.names[n]] for n in rows]
        seen = directions(constellation, latitude, longitude, start[r] + seconds)
        nodes[r][:, columns] = seen[:, rows]
        if config.signal_in_space == "broadcast":
            sigma[r, columns] = constellation.accuracy_m[rows]
        high = elevation_rad(nodes[r, 0]) >= math.radians(config.elevation_mask_deg)
        needed = 3 + len(np.unique(CLOCK_OF_SYSTEM[system[high]]))
        if high.sum() < max(needed, 4):
            _refuse(config, int(high.sum()), float(start[r]) - first)
    count = len(names)
    normal = normals(seed, runs, Stream.GNSS_WAVES, count, 1, _FIELDS * WAVES * 4)
    uniform = uniforms(seed, runs, Stream.GNSS_PHASES, count, 1, _FIELDS * WAVES)
    return GnssScene(
        config=config,
        names=names,
        clock=CLOCK_OF_SYSTEM[system],
        nodes=nodes,
        signal_in_space_m=sigma,
        common=normals(seed, runs, Stream.GNSS_COMMON, count, 1, 3)[:, :, 0],
        fields=waves(
            normal.reshape(len(runs), count, _FIELDS, WAVES, 4),
            uniform.reshape(len(runs), count, _FIELDS, WAVES),
            config.multipath_length_m,
            config.multipath_time_s,
        ),
        obstacles=obstacles,
        start_s=start,
    )


def _all_satellites(config: Gnss, data_folder: Path | None) -> tuple[tuple[str, ...], Index]:
    """Every satellite of the wanted systems, also those that are not there at some time, in a fixed order."""
    whole: Constellation
    if config.file is None:
        whole = nominal_constellation()
    else:
        records = read_rinex_navigation(find_data_file(config.file, data_folder))
        whole = BroadcastConstellation(records.take(np.unique(records.name, return_index=True)[1]))
    wanted = np.isin(whole.system, [SYSTEMS.index(name) for name in config.systems])
    names = tuple(name for name, kept in zip(whole.names, wanted, strict=True) if kept)
    return names, whole.system[wanted]


def _refuse(config: Gnss, count: int, late_s: float) -> None:
    source = "the nominal constellation" if config.file is None else f'"{config.file}"'
    raise ProblemError(
        "navigation",
        [
            f"{count} satellites of {source} stand above elevation_mask_deg = {config.elevation_mask_deg:g} "
            f"{late_s / 3600.0:.2f} h after start_gps_time = {config.start_gps_time}: too few for a position;"
            " lower the mask, choose another time or a shorter start_spread_h, or receive more systems"
        ],
    )
