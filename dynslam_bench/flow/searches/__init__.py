"""Label searches: one interface, budgets counted in cost evaluations, anytime and monotone."""
