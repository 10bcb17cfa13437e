"""Float64 oracles: the definitions of the design once more, in plain loops, importing nothing of ours.

A kernel is right when it agrees with these on every case that no threshold decides by rounding. They are
written from the text, not from the kernels; slow on purpose, so tests keep their inputs small.
"""
