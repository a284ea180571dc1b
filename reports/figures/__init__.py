"""The report's figures as plotly specifications."""
