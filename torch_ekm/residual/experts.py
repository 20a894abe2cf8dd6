"""Figures by which the experts of a mixture are judged, in torch and in compiled loops."""

FREEDOM = 10.0  #: of the t law that judges the experts: an outlier must not decide alone
LEVEL_DECAY, TREND_DECAY = 0.995, 0.98
YOUNG = 4  #: samples that are not judged by: learners do not know their units yet
#: share of the running rms by which experts are judged, and at most so many typical scales
RMS_LEAST, RMS_MOST = 0.5, 6.0
RATE = 0.01  #: of the running variance
#: running variances that one sample counts for, at most: a single -999 must not inflate the next thousand
SQUARE_MOST = 100.0
FARTHEST = 1e6  #: standard deviations
LEAST = -50.0  #: log evidence: nobody is ruled out for good
