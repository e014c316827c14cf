"""Where the time of a model goes: by kind of operator, and beside what this machine could do."""
