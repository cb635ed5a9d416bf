"""Constraints of the QP planner: rows in metres, m/s or radians."""
