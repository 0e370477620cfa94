"""What is asked for: steps, own terms, and the phases they come to."""
