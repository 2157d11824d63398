"""The public benchmark: tasks, entrants, scores."""
