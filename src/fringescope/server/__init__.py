"""The hub: one shared truth about each case, for the operator's screen, the expert's page and programs.

    people -> rights -> hub (order, log, state) -> rooms
                         |
                         +-> instrument (its own process) and workshop (another)

`hub` gives every word its place in the case's log and folds it into `truth`; `instrument` carries out what the state
asks for; routes translate between HTTP and these, and decide nothing.
"""
