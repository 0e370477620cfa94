"""Forces and torques of a motion: what the motors of the arm have to do, and what is in the hand."""
