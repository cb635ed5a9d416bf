"""UAV formation flight among obstacles with uncertain navigation."""
