"""What comes in: what is unsound or too much is refused, counted and said in words.

``validation``   unsound values, and why
``rate_limit``, ``repeats``, ``voices``  one RSU that sends too much, is stuck, or is two
``admission``    which devices are tracked
``refusals``     counts and words
"""
