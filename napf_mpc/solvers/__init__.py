"""Solvers of the QP planner: one file a back-end, one vocabulary of statuses, one test before flight."""
