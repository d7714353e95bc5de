"""Results seen on top of the recording: pictures, videos and Foxglove annotations."""
