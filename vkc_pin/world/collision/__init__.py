"""Computes signed distances of many shape pairs at once, with coal in compiled code."""
