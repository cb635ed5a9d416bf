"""Artificial potential field (section 3.1, Eq. 23-39): plain functions, one equation each.

``rho`` is the distance to the obstacle's *surface* (for a point obstacle the distance to its centre, as in
Eq. 24); with NAPF the caller passes the distance less the navigation margin. Forces are in the paper's
units, in which a force adds to a velocity (Eq. 37).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def repulsive_potential(rho: Array, gain: float, influence_m: float, floor_m: float = 0.1) -> Array:
    """FIRAS potential U_rep = k_r / 2 (1/rho - 1/rho_0)^2 inside rho_0, zero outside (Eq. 23).

    Parameters
    ----------
    rho : array, shape (...)
        Distance [m]; below ``floor_m`` it counts as ``floor_m``, so that contact stays finite.
    gain : float
        k_r.
    influence_m : float
        rho_0 [m].
    floor_m : float
        Least distance [m].

    Returns
    -------
    array, shape (...)
        Potential.
    """
    inverse = 1.0 / np.maximum(rho, floor_m) - 1.0 / influence_m
    return np.where(rho < influence_m, 0.5 * gain * inverse**2, 0.0)


def attractive_potential(position: Array, goal: Array, gain: float) -> Array:
    """U_att = k_a / 2 |X - X_g|^2 (Eq. 25), (..., dim) -> (...)."""
    offset = position - goal
    return 0.5 * gain * np.asarray((offset * offset).sum(-1))


def attractive_force(position: Array, goal: Array, gain: float) -> Array:
    """F_att = k_a (X_g - X), the negative gradient of Eq. 25 (Eq. 27, as read), (..., dim)."""
    return gain * (goal - position)


def repulsion(rho: Array, gain: float, influence_m: Array | float, floor_m: float) -> Array:
    """Magnitude of the repulsive force k_r (1/rho - 1/rho_0) / rho^2 inside rho_0 (Eq. 28).

    Parameters
    ----------
    rho : array, shape (...)
        Distance [m]; below ``floor_m`` it counts as ``floor_m``: the force is finite at contact and inside.
    gain : float
        k_r.
    influence_m : array or float, shape (...)
        rho_0 [m].
    floor_m : float
        Least distance [m].

    Returns
    -------
    array, shape (...)
        Magnitude, >= 0.
    """
    held = np.maximum(rho, floor_m)
    return np.where(rho < influence_m, gain * (1.0 / held - 1.0 / influence_m) / (held * held), 0.0)


def repulsive_force(
    rho: Array, gradient: Array, gain: float, influence_m: Array | float, floor_m: float
) -> Array:
    """Sum over obstacles of the repulsive forces along the distance gradients (Eq. 28, 29, 36).

    Parameters
    ----------
    rho : array, shape (..., m)
        Distances to m obstacles [m]; infinite for none.
    gradient : array, shape (..., m, 3)
        Unit gradients of the distances: away from the obstacles (Eq. 33's printed angle points towards).
    gain, influence_m, floor_m
        As in :func:`repulsion`.

    Returns
    -------
    array, shape (..., 3)
        Force.
    """
    magnitude = repulsion(rho, gain, influence_m, floor_m)
    total = np.zeros((*gradient.shape[:-2], gradient.shape[-1]))
    # One after the other: a library sum may group its terms by the length of the padded axis.
    for j in range(gradient.shape[-2]):
        total += magnitude[..., j, None] * gradient[..., j, :]
    return total


def velocity_update(reference_velocity: Array, force: Array, max_speed_mps: float) -> Array:
    """V_i = -grad U + V_bar_i, its norm held at a largest speed (Eq. 37), (..., 3) [m/s]."""
    velocity = reference_velocity + force
    speed = _norm(velocity)
    return velocity * np.minimum(1.0, max_speed_mps / np.maximum(speed, max_speed_mps))[..., None]


def heading_and_climb(velocity: Array) -> tuple[Array, Array]:
    """Heading atan2(V_y, V_x) and climb angle atan2(V_z, hypot(V_x, V_y)) (Eq. 38, as read) [rad]."""
    horizontal = np.hypot(velocity[..., 0], velocity[..., 1])
    return np.arctan2(velocity[..., 1], velocity[..., 0]), np.arctan2(velocity[..., 2], horizontal)


def limit_turn(velocity: Array, path_direction: Array, left: Array, max_turn_rad: float) -> Array:
    """Direction of a velocity, turned from the path's by a largest angle (Eq. 39, as read, in 3-D).

    The direction stays in the plane of path and velocity. A velocity of zero gives the path's direction;
    one straight against the path has no such plane and is turned towards ``left``.

    Parameters
    ----------
    velocity : array, shape (..., 3)
        Commanded velocity [m/s].
    path_direction, left : array, shape (3,)
        Unit vectors, perpendicular.
    max_turn_rad : float
        Largest angle, 0 to pi/2 [rad].

    Returns
    -------
    array, shape (..., 3)
        Unit vectors.
    """
    forward = _dot(velocity, path_direction) + 0.0  # no -0.0, which arctan2 takes for straight back
    sideways = velocity - forward[..., None] * path_direction
    across = _norm(sideways)
    # Below that the side is rounding error, and would not be perpendicular to the path.
    straight_back = (forward < 0.0) & (across <= -1e-9 * forward)
    side = np.where(straight_back[..., None], left, sideways / np.where(across > 0.0, across, 1.0)[..., None])
    angle = np.minimum(np.arctan2(np.where(straight_back, 0.0, across), forward), max_turn_rad)
    return np.asarray(np.cos(angle)[..., None] * path_direction + np.sin(angle)[..., None] * side)


def _dot(vectors: Array, axis: Array) -> Array:
    return np.asarray(vectors[..., 0] * axis[0] + vectors[..., 1] * axis[1] + vectors[..., 2] * axis[2])


def _norm(vectors: Array) -> Array:
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)


@dataclass(frozen=True)
class Walk:
    """Path of a point that walks down the potential (Eq. 35)."""

    positions: Array
    """(step, 2) [m]."""
    arrived: bool
    """Whether the goal was reached."""
    stuck: bool
    """Whether the walk was given up because it no longer gained on the goal (a local minimum)."""


def angle_step_walk(
    start: Array,
    goal: Array,
    nearest: Callable[[Array], tuple[Array, Array]],
    *,
    attractive_gain: float,
    repulsive_gain: float,
    influence_m: float,
    floor_m: float,
    step_m: float,
    arrival_m: float,
    max_steps: int,
    patience: int = 1000,
) -> Walk:
    """Traditional angle-step APF of one point in the plane (Eq. 29-35, vector form).

    Each step has the fixed length gamma along the direction of the total force. A walk that has not come
    closer to the goal for ``patience`` steps is in a local minimum and is given up, as the method has no
    way out of one.

    Parameters
    ----------
    start, goal : array, shape (2,)
        [m].
    nearest : callable
        Maps a position (2,) to the distances (m,) [m] and unit gradients (m, 2) of the obstacles.
    attractive_gain, repulsive_gain : float
        k_a and k_r.
    influence_m, floor_m : float
        rho_0 and the least distance [m].
    step_m : float
        gamma [m].
    arrival_m : float
        Distance to the goal that counts as arrived [m].
    max_steps : int
        Largest number of steps.
    patience : int
        Steps without gain after which the walk is stuck.

    Returns
    -------
    Walk
        The path and how it ended.
    """
    position = np.array(start, dtype=float)
    path = [position.copy()]
    best, best_step = np.inf, 0
    for step in range(max_steps):
        remaining = float(np.hypot(*(goal - position)))
        if remaining <= arrival_m:
            return Walk(np.array(path), arrived=True, stuck=False)
        if remaining < best - 1e-9:
            best, best_step = remaining, step
        elif step - best_step >= patience:
            return Walk(np.array(path), arrived=False, stuck=True)
        rho, gradient = nearest(position)
        magnitude = repulsion(rho, repulsive_gain, influence_m, floor_m)
        force = attractive_force(position, goal, attractive_gain) + (magnitude[:, None] * gradient).sum(0)
        size = float(np.hypot(*force))
        if size == 0.0:
            return Walk(np.array(path), arrived=False, stuck=True)
        position = position + step_m * force / size
        path.append(position.copy())
    arrived = float(np.hypot(*(goal - position))) <= arrival_m
    return Walk(np.array(path), arrived=arrived, stuck=False)
