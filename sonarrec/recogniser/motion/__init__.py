"""How the sonar moved from frame to frame: from poses, or measured in the images."""
