"""Simulated traverses: at measurement level, and rendered with exact truth."""
