"""Episodes as files, and what shows them: three-dimensional pictures, a window, a page in the browser."""
