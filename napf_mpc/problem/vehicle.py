"""Keys of ``[vehicle]``."""

from __future__ import annotations

from pydantic import Field

from napf_mpc.problem.section import Inertia, InputWeight, Section, StateWeight


class Vehicle(Section):
    """Quadrotor, its rotors and its LQR (Eq. 1-13). Defaults are the paper's."""

    mass_kg: float = Field(1.0, ge=0.01, le=1000.0)
    """Mass."""
    inertia_kgm2: tuple[Inertia, Inertia, Inertia] = (8.1e-3, 8.1e-3, 14.2e-3)
    """Moments of inertia about the body's x, y, z axes."""
    arm_m: float = Field(0.24, ge=0.01, le=10.0)
    """Distance from the centre to a rotor; not printed in the paper, enters only the mixer."""
    lift_coefficient: float = Field(54.2e-6, ge=1e-9, le=1.0)
    """Rotor thrust over squared speed [N s^2]."""
    drag_coefficient: float = Field(4.2e-6, ge=1e-10, le=1.0)
    """Rotor drag torque over squared speed [N m s^2]."""
    thrust_to_weight: float = Field(2.2, ge=1.05, le=20.0)
    """Largest total thrust over weight; each rotor gives a quarter of it at most and zero at least."""
    radius_m: float = Field(0.3, ge=0.0, le=10.0)
    """Radius of the ball that holds the UAV, for clearance and collision."""
    min_separation_m: float = Field(0.6, ge=0.0, le=100.0)
    """Centre distance under which two UAVs count as in contact."""
    lqr_q_diagonal: tuple[
        StateWeight, StateWeight, StateWeight, StateWeight, StateWeight, StateWeight,
        StateWeight, StateWeight, StateWeight, StateWeight, StateWeight, StateWeight,
    ] = (0.1,) * 12  # fmt: skip
    """Diagonal of Q (Eq. 12), in the order of the state (Eq. 1)."""
    lqr_r_diagonal: tuple[InputWeight, InputWeight, InputWeight, InputWeight] = (0.1, 10.0, 100.0, 10.0)
    """Diagonal of R (Eq. 12), in the order of the input (Eq. 2)."""
    max_velocity_error_mps: float = Field(2.0, ge=0.1, le=100.0)
    """Largest velocity error that the LQR is shown; a larger one would tumble the UAV."""
    max_position_error_m: float = Field(1.5, ge=0.1, le=1000.0)
    """Largest position error that the LQR is shown."""
