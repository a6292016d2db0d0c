"""``fusion report``: the paper's figures and its table from one's own data, on one page."""
