"""Input of all kinds that was never meant to work: what comes of it must be a result, or an error of the package's own."""
