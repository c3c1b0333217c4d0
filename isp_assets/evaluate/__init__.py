"""Measure: draped frames (`frames`), rest shapes (`reconstruction`), any code at all (`robustness`)."""
