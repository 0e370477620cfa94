"""Signed distances of many placed shapes at once, by coal in compiled code; knows neither robots nor scenes."""
