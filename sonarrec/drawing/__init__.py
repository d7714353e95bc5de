"""Draws estimates and the stated geometry onto fan images."""
