"""What a sonar is and gives: what is stated of it, its frames, and where their pixels lie."""
