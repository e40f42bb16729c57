"""What the pages of all commands share: pages and figures as files, drawings, numbers as text.

Importing it imports neither matplotlib nor Jinja2.
"""
