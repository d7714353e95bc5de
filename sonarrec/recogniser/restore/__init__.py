"""Pictures as the sonar made them: static pixels, saturated levels, beam width."""
