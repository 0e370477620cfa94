"""Models grippers: finger joints and the opening between the fingers."""
