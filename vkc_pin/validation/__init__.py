"""The independent check: is a motion right? Knows neither chain nor program."""
