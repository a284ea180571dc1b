"""What a report knows: rows, the board, statistics, published numbers."""
