"""Probabilities too small for plain Monte Carlo: subset simulation, and missions as its limit state."""
