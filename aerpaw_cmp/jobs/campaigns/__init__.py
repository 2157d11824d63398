"""Many flights: plan, tasks, fits over flights, seasons."""
