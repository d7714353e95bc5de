"""The messages in MCAP files and ROS bags: their types, and how their bytes are decoded."""
