"""Holding by friction alone: fingers that close, the pauses in which they do, and what they hold."""
