"""How far objects and motions are from the truth."""
