"""Mutation testing: small slips are put into the stages one at a time; which of them do the tests notice?

``python -m tests.mutation --count 300`` prints those that no test notices, and the share that one does.
"""
