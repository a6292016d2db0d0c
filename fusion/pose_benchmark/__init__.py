"""How well are new views located? A protocol of trials with bars, run on datasets, with its table and pictures."""
