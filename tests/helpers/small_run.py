"""Words that make a training small, for tests of what a run leaves and not of what it learns."""

PLACE = ["scenario.maps=[0]", "scenario.held_out=[70]", "scenario.macro_steps=2", "scenario.local_steps=3"]
SMALL = [*PLACE, "num_envs=2", "num_robots=2", "collector.steps=2", "model.channels=4"]
