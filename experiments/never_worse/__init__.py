"""Tasks for which no setting was chosen: does discovery cost anything there?"""
