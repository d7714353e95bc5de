"""`sonarrec site`: how landmarks laid into a recording would be recognised."""
