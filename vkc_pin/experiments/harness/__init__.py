"""Runs experiments and makes their records, tables and charts."""
