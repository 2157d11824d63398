"""The page of a campaign: many flights and settings."""
