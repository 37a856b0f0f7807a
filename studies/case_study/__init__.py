"""The paper's case study as one command (`python -m studies case`): steps that a file names, and a page of answers.

``study_file`` says what can be asked, ``steps`` performs it, each step in a folder of its own that is named after all
that it depends on, and ``page`` puts the paper's numbers beside those of the results. What a step does is a function
of its settings, of the folders of the steps that it reads, and of nothing else.
"""
