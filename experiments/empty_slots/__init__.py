"""Do empty slots harm?"""
