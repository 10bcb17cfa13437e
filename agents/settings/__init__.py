"""The name that `maexp.agents.config` had up to version 0.2: documented paths stay."""
