"""Other systems' messages and key mappings, for the dialects of a server and for the policy
`upstream`.
"""
