"""Readers of receivers' and autopilots' logs: each gives positions with their reported covariance."""
