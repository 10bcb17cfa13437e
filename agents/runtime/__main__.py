"""`python -m maexp.agents.runtime`: the measurements of `maexp.agents.deploy.planner`."""

from maexp.agents.deploy.planner.__main__ import main

main()
