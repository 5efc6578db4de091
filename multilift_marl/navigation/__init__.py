"""Whole routes of a team among obstacles: shapes of the formation, a search, a smooth curve, speeds along it."""
