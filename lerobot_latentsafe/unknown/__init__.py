"""The monitor of the unknown: how strange what is seen and what follows from it is, beside healthy episodes.

`appearance` scores each camera, `dynamics` what was foretold, `threshold` sets the threshold, `monitor` puts them
together. Nothing here decides: what is done about an alarm is the law's (`LawConfig.unknown`).
"""
