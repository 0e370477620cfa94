"""`python -m tests.kills ... -- COMMAND`: worker processes of a command are killed at random moments."""
