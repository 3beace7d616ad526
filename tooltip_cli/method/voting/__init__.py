"""Beyond the paper: vote with all moving edges in a volume fixed to the hand, then find its end.

``pairing`` chooses frames and partners by the hand's motion, ``moving`` finds the edges that move
against the background, ``volume`` gives each of them a depth, ``end`` finds the far end of what
appears, and ``estimate`` puts them together. ``docs/voting.md`` has the derivations.
"""
