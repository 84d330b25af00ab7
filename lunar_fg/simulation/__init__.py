"""Simulated traverses with exact truth."""
