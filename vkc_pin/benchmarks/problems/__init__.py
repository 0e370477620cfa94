"""Sixty problems that nothing was tuned on, and what is measured on them."""
