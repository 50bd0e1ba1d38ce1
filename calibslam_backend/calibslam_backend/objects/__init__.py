"""How quadrics begin, are united, and end."""
