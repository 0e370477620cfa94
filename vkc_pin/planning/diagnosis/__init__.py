"""Why a task cannot be done, as far as that is known."""
