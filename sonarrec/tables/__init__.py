"""Reads TOML, CSV and Parquet, and writes files safely."""
