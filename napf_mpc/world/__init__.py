"""The world that UAVs fly in: solids with exact distances, obstacle sets, scenes, cities, swept verdicts."""
