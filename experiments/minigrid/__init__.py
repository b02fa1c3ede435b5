"""Do options that are discovered in a small task of MiniGrid make an agent quick in a large one?"""
