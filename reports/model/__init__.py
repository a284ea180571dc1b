"""The data of a report: rows, the board, statistics, published numbers."""
