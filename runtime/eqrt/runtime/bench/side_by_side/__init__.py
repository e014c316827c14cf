"""Several models in one run, beside physics: what does each cost, and what is it worth?"""
