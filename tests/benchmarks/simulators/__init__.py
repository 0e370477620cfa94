"""Environments of other people, in environments of their own, whose tasks vkc_pin plans.

A script of each environment writes compiled models and states into folders, one of `vkc_pin` plans
for them, and the first one executes the motions through the environment's own interface.
"""
