"""Furniture and appliances builder by rule and number: what they are like, where their handles are, and how these are taken."""
