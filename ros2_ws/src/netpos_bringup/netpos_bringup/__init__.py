"""Launch files, scenarios and the processes that ``netpos bench`` measures the live node with."""
