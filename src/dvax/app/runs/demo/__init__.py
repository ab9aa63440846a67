"""The demonstration: a rough strip pressed onto a foundation under an irregular load."""
