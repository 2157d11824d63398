"""Each job as named stages: report, campaign, map, bench."""
