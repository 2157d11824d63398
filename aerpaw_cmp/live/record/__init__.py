"""The tap's durable log, its writer and its export."""
