"""Files of our kinds: TOML, tables and Parquet read, and what may be written over."""
