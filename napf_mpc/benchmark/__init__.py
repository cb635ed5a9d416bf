"""Benchmarks that users run themselves: solvers on the programs of the planner's own flights."""
