"""How the map predictor that ships was made, and one of your own is: docs/predictor.md."""
