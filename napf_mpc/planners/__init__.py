"""Planners: from a navigation solution and the map to a command."""
