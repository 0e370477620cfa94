"""Robots × objects: does every robot open every thing that its hand can take hold of, where the shapes say that it can?"""
