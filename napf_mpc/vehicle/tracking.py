"""The inner loop: the LQR on cross-track and velocity error, within rotor limits (Eq. 13, 14, 20-22)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napf_mpc.errors import ProblemError
from napf_mpc.jit import compiled, compiled_bare
from napf_mpc.problem import Vehicle
from napf_mpc.vehicle.lqr import hover_gain
from napf_mpc.vehicle.plant import plain
from napf_mpc.vehicle.quadrotor import INPUTS, hover_input, mixer, mixer_inverse, rotor_limit

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackingLaw:
    """Everything the inner loop needs of a vehicle; :func:`tracking_law` builds it."""

    gain: Array
    """(4, 12) LQR gain at hover and yaw zero."""
    mixer: Array
    """(4, 4) rotor thrusts to input."""
    mixer_inverse: Array
    """(4, 4) input to rotor thrusts."""
    rotor_limit: float
    """Largest thrust of one rotor [N]; the least is zero."""
    hover_thrust: float
    """Thrust that holds the vehicle in the air [N]."""
    max_position_error: float
    """Largest position error that the LQR is shown [m]."""
    max_velocity_error: float
    """Largest velocity error that the LQR is shown [m/s]."""

    def inputs(
        self,
        position: Array,
        velocity: Array,
        attitude: Array,
        rates: Array,
        ref_position: Array,
        ref_velocity: Array,
        direction: Array,
        ref_yaw: Array,
        feedforward: Array,
        active: NDArray[np.bool_],
    ) -> Array:
        """Return the input of every UAV: ``U = U_hover + feedforward - K chi``, clipped to the rotors.

        With ``d = X - P``, chi holds the cross-track error ``e_p = (I3 - n n^T) d`` (Eq. 14 as read; all of d
        where n is zero), the velocity error ``e_v = X' - V_ref``, attitude and rates. Both errors are clamped
        by their norm, which keeps their direction: the LQR is linear, and on the nonlinear vehicle jumps of
        15 m and 8 m/s, if shown whole, command tilts from which it tumbles. Their horizontal parts are turned
        into the frame of ``ref_yaw``, where the gain, derived at yaw zero, holds; the yaw error is
        wrapped to (-pi, pi].

        Each rotor's thrust is clipped alone to [0, limit], as a motor does: a saturated rotor changes thrust
        and torques together, no axis has priority. An input that needs no clipping is passed on as it is.

        Parameters
        ----------
        position, velocity : array, shape (run, uav, 3)
            As navigation reports them [m, m/s].
        attitude, rates : array, shape (run, uav, 3)
            Roll, pitch, yaw [rad] and their rates [rad/s], as reported.
        ref_position : array, shape (run, uav, 3)
            Path point P, or the point to hold [m].
        ref_velocity : array, shape (run, uav, 3)
            Velocity to fly, n V of Eq. 14 [m/s].
        direction : array, shape (run, uav, 3)
            Direction n of the path; only its direction counts, zero means hold the point.
        ref_yaw : array, shape (run, uav)
            Yaw to hold [rad].
        feedforward : array, shape (run, uav, 4)
            Added to the hover input [N, N m].
        active : array of bool, shape (run,)
            Runs that fly; the others get the hover input.

        Returns
        -------
        array, shape (run, uav, 4)
            Thrust [N] and torques [N m]. Where something that navigation or the planner gave is not finite,
            the input is not finite either: a fault is never turned into a harmless command.

        Raises
        ------
        ProblemError
            A shape does not fit.
        """
        runs, uavs = position.shape[:2] if position.ndim == 3 else (-1, -1)
        vectors = {
            "position": position, "velocity": velocity, "attitude": attitude, "rates": rates,
            "ref_position": ref_position, "ref_velocity": ref_velocity, "direction": direction,
        }  # fmt: skip
        faults = [
            f"{name} must have shape (run, uav, {axes}) = {(runs, uavs, axes)}, got {array.shape}"
            for axes, group in ((3, vectors), (INPUTS, {"feedforward": feedforward}))
            for name, array in group.items()
            if array.shape != (runs, uavs, axes)
        ]
        if ref_yaw.shape != (runs, uavs):
            faults.append(f"ref_yaw must have shape (run, uav) = {(runs, uavs)}, got {ref_yaw.shape}")
        if active.shape != (runs,):
            faults.append(f"active must have shape (run,) = {(runs,)}, got {active.shape}")
        if faults:
            raise ProblemError("inner loop", faults)
        out = np.empty((runs, uavs, INPUTS))
        track(
            plain(position), plain(velocity), plain(attitude), plain(rates),
            plain(ref_position), plain(ref_velocity), plain(direction), plain(ref_yaw), plain(feedforward),
            self.gain, self.mixer, self.mixer_inverse, self.rotor_limit, self.hover_thrust,
            self.max_position_error, self.max_velocity_error, active.astype(np.bool_), out,
        )  # fmt: skip
        return out


def tracking_law(vehicle: Vehicle) -> TrackingLaw:
    """Return the inner loop of a vehicle: its LQR at hover, its mixer and its limits.

    Raises
    ------
    ProblemError
        The vehicle's weights give no stable regulator.
    """
    return TrackingLaw(
        gain=hover_gain(vehicle).gain,
        mixer=mixer(vehicle),
        mixer_inverse=mixer_inverse(vehicle),
        rotor_limit=rotor_limit(vehicle),
        hover_thrust=float(hover_input(vehicle)[0]),
        max_position_error=vehicle.max_position_error_m,
        max_velocity_error=vehicle.max_velocity_error_mps,
    )


@compiled_bare
def _shrink(x: float, y: float, z: float, largest: float) -> float:
    """Factor that brings a vector's norm to at most ``largest``: 1 inside, NaN if it is not finite."""
    norm = math.sqrt(x * x + y * y + z * z)
    if norm <= largest:
        return 1.0
    return largest / norm if norm < math.inf else math.nan


@compiled_bare
def _wrap(angle: float) -> float:
    """The same angle in (-pi, pi]; NaN for one that is not finite."""
    if -math.pi < angle <= math.pi:
        return angle
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


@compiled
def track(
    position: Array,
    velocity: Array,
    attitude: Array,
    rates: Array,
    ref_position: Array,
    ref_velocity: Array,
    direction: Array,
    ref_yaw: Array,
    feedforward: Array,
    gain: Array,
    mixer: Array,
    mixer_inverse: Array,
    rotor_limit: float,
    hover_thrust: float,
    max_position_error: float,
    max_velocity_error: float,
    active: NDArray[np.bool_],
    out: Array,
) -> None:
    """Compiled body of :meth:`TrackingLaw.inputs`: unchecked, writes into ``out`` (run, uav, 4)."""
    chi, wanted, rotors = np.empty(12), np.empty(4), np.empty(4)
    for run in range(position.shape[0]):
        for uav in range(position.shape[1]):
            out[run, uav, 0] = hover_thrust
            out[run, uav, 1:] = 0.0
            if not active[run]:
                continue
            _errors(
                position[run, uav], velocity[run, uav], attitude[run, uav], rates[run, uav],
                ref_position[run, uav], ref_velocity[run, uav], direction[run, uav], ref_yaw[run, uav],
                max_position_error, max_velocity_error, chi,
            )  # fmt: skip
            for i in range(4):
                total = 0.0
                for j in range(12):
                    total += gain[i, j] * chi[j]
                wanted[i] = out[run, uav, i] + feedforward[run, uav, i] - total
            _clip(wanted, mixer, mixer_inverse, rotor_limit, rotors, out[run, uav])


@compiled_bare
def _errors(
    position: Array,
    velocity: Array,
    attitude: Array,
    rates: Array,
    ref_position: Array,
    ref_velocity: Array,
    direction: Array,
    ref_yaw: float,
    max_position_error: float,
    max_velocity_error: float,
    chi: Array,
) -> None:
    """Error state of one UAV in the frame of its reference yaw (Eq. 14), written into chi (12,)."""
    nx, ny, nz = direction[0], direction[1], direction[2]
    ex = position[0] - ref_position[0]
    ey = position[1] - ref_position[1]
    ez = position[2] - ref_position[2]
    square = nx * nx + ny * ny + nz * nz
    if square != 0.0:
        along = (nx * ex + ny * ey + nz * ez) / square
        ex -= nx * along
        ey -= ny * along
        ez -= nz * along
    vx = velocity[0] - ref_velocity[0]
    vy = velocity[1] - ref_velocity[1]
    vz = velocity[2] - ref_velocity[2]
    scale_e = _shrink(ex, ey, ez, max_position_error)
    scale_v = _shrink(vx, vy, vz, max_velocity_error)
    c, s = math.cos(ref_yaw), math.sin(ref_yaw)
    chi[0] = scale_e * (c * ex + s * ey)
    chi[1] = scale_v * (c * vx + s * vy)
    chi[2] = scale_e * (c * ey - s * ex)
    chi[3] = scale_v * (c * vy - s * vx)
    chi[4] = scale_e * ez
    chi[5] = scale_v * vz
    chi[6], chi[7] = attitude[0], rates[0]
    chi[8], chi[9] = attitude[1], rates[1]
    chi[10], chi[11] = _wrap(attitude[2] - ref_yaw), rates[2]


@compiled_bare
def _clip(
    wanted: Array, mixer: Array, mixer_inverse: Array, rotor_limit: float, rotors: Array, out: Array
) -> None:
    """Write the input that the rotors give when ``wanted`` is asked of them into out (4,)."""
    for i in range(4):
        # An infinite command must not come out as a clipped, harmless one.
        if not math.isfinite(wanted[i]):
            out[:] = math.nan
            return
    clipped = False
    for i in range(4):
        thrust = 0.0
        for j in range(4):
            thrust += mixer_inverse[i, j] * wanted[j]
        if thrust < 0.0:
            thrust, clipped = 0.0, True
        elif thrust > rotor_limit:
            thrust, clipped = rotor_limit, True
        rotors[i] = thrust
    for i in range(4):
        if clipped:
            out[i] = 0.0
            for j in range(4):
                out[i] += mixer[i, j] * rotors[j]
        else:
            out[i] = wanted[i]
