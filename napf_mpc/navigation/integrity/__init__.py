"""How far a position may be off: tails of the error's law, overbounds, protection levels, their judgement."""
