"""What each command of `biped-mfpt` accepts, the commands by what they are about.

Imports nothing but argparse: `--help` has to be quick.
"""
