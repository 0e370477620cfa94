"""`python -m tests.episodes DATASET`: every episode of a dataset is judged by the oracle."""
