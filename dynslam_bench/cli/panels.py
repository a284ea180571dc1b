"""Headings below which the program's help lists its verbs."""

START, MEASURE = "Begin here", "Run and measure"
REPORT, CARE = "Report and tune", "Extend and care"
