"""Joints that follow others, as in a telescope: one coordinate moves all of them."""
