"""Hands: their fingers, how these open and close, and how much fits between them."""
