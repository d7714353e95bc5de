"""Presets side by side over the same frames, and the revision in hindsight."""
