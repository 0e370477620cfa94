"""Provides argument checks, array types, budgets, caches and parallel execution."""
