"""Networks: the target generator, the choice among targets, actors and critics."""
