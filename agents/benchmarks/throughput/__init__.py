"""The measurements of `maexp bench`: one file each, and the counting behind them."""
