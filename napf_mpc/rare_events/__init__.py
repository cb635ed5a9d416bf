"""Probabilities too small for plain Monte Carlo: subset simulation, and missions as its limit state."""

from napf_mpc.rare_events.subset import SubsetResult, subset_simulation

__all__ = ["SubsetResult", "subset_simulation"]
