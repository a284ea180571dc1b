"""The report's figures as plotly-like specifications."""
